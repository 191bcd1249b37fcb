"""CAN FD frames as the levels on the bus, written from ISO 11898-1:2015, for fd_bits_agree_with_python.rs.

Reads lines "identifier in hexadecimal, x or -, BRS, ESI, bytes in hexadecimal or -" and prints for each the bits at the nominal
rate, the bits at that of the data phase, the stuff bits before the CRC field, the fixed stuff bits, and the CRC.
"""

import sys

LENGTHS = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]


def bits(value, width):
    return format(value, f"0{width}b") if width else ""


def dynamic_stuffing(text):
    """The stream with a complementary bit after five equal ones, and the new positions of the text's bits."""
    out, places = "", []
    for bit in text:
        if len(out) >= 5 and out[-5:] == out[-1] * 5:
            out += "1" if out[-1] == "0" else "0"
        places.append(len(out))
        out += bit
    return out, places


def remainder(text, polynomial):
    """The CRC as long division, the dividend preceded by the start value: a one and zeros."""
    width = polynomial.bit_length() - 1
    value = int(text + "0" * width, 2) ^ (1 << (len(text) + width - 1))
    for at in range(len(text) + width - 1, width - 1, -1):
        if value >> at & 1:
            value ^= polynomial << (at - width)
    return value


def frame(identifier, extended, brs, esi, data):
    text = "0"
    if extended:
        text += bits(identifier >> 18, 11) + "11" + bits(identifier & 0x3FFFF, 18) + "0"
    else:
        text += bits(identifier, 11) + "00"
    text += "10" + str(brs)
    switched = len(text)
    text += str(esi) + bits(LENGTHS.index(len(data)), 4) + "".join(bits(byte, 8) for byte in data)
    stuffed, places = dynamic_stuffing(text)
    stuff = len(stuffed) - len(text)
    gray = stuff % 8 ^ stuff % 8 >> 1
    count = bits(gray, 3)
    count += str(count.count("1") % 2)
    # x17 + x16 + x14 + x13 + x11 + x6 + x4 + x3 + x + 1, and x21 + x20 + x13 + x11 + x7 + x4 + x3 + 1.
    powers = (17, 16, 14, 13, 11, 6, 4, 3, 1, 0) if len(data) <= 16 else (21, 20, 13, 11, 7, 4, 3, 0)
    polynomial = sum(1 << power for power in powers)
    crc = remainder(stuffed + count, polynomial)
    field, fixed = count + bits(crc, powers[0]), 0
    out = stuffed
    for at in range(0, len(field), 4):
        out += "1" if out[-1] == "0" else "0"
        fixed += 1
        out += field[at : at + 4]
    out += "1"  # CRC delimiter
    first = places[switched - 1] + 1
    tail = 1 + 1 + 7 + 3
    nominal, fast = (first + tail, len(out) - first) if brs else (len(out) + tail, 0)
    return nominal, fast, stuff, fixed, crc


for line in sys.stdin:
    identifier, extended, brs, esi, data = line.split()
    data = bytes.fromhex("" if data == "-" else data)
    print(*frame(int(identifier, 16), extended == "x", int(brs), int(esi), data))
