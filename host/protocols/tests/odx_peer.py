"""Messages of an ODX file, with what the Python package odxtools reads in them.

odx_peer.py FILE SEED ROUNDS: for each message a line, a JSON object. Half of the messages are random behind what is constant, the others
are what odxtools encodes from the values of one.
"""

import json
import logging
import random
import struct
import sys
import warnings

import odxtools
from odxtools.diagnostictroublecode import DiagnosticTroubleCode
from odxtools.diagservice import DiagService
from odxtools.parameters.matchingrequestparameter import MatchingRequestParameter
from odxtools.parameters.reservedparameter import ReservedParameter

MOST_BYTES = 24


def flat(path, value, out):
    """Values with their paths, as we write them."""
    if isinstance(value, dict):
        for name, inner in value.items():
            flat(f"{path}.{name}" if path else name, inner, out)
    elif isinstance(value, (list,)):
        for at, inner in enumerate(value):
            flat(f"{path}[{at}]", inner, out)
    elif isinstance(value, tuple):
        name, inner = value
        if inner == {}:
            out.append([path, "text", name])
        elif inner is not None:
            flat(f"{path}.{name}", inner, out)
    elif isinstance(value, DiagnosticTroubleCode):
        out.append([path, "int", value.trouble_code])
    elif isinstance(value, (bytes, bytearray)):
        out.append([path, "bytes", bytes(value).hex()])
    elif isinstance(value, str):
        out.append([path, "text", value])
    elif isinstance(value, int):
        out.append([path, "int", value])
    elif isinstance(value, float):
        out.append([path, "real", struct.pack(">d", value).hex()])


def read(message, data):
    """What a message says, or nothing if it is none."""
    try:
        values = message.decode(bytes(data))
    except Exception:
        return None
    reserved = {param.short_name for param in message.parameters if isinstance(param, ReservedParameter)}
    out = []
    flat("", {name: value for name, value in values.items() if name not in reserved}, out)
    return out


def made(message, request, codes, rng):
    """A message: what is constant, and random bytes, or known trouble codes."""
    prefix = message.coded_const_prefix(request_prefix=bytes(request or b""))
    data = bytearray(prefix)
    if codes and rng.randrange(4) == 0:
        data.append(rng.randrange(256))
        for _ in range(rng.randrange(4)):
            data += rng.choice(codes).to_bytes(3, "big") + bytes([rng.randrange(256)])
    else:
        data += bytes(rng.choice([rng.randrange(256), rng.randrange(4)]) for _ in range(rng.randrange(MOST_BYTES)))
    for param in message.parameters if request is not None else []:
        if isinstance(param, MatchingRequestParameter) and param.byte_position is not None:
            part = request[param.request_byte_position :][: param.byte_length]
            if len(part) == param.byte_length and len(data) >= param.byte_position + len(part):
                data[param.byte_position : param.byte_position + len(part)] = part
    return bytes(data)


def encoded(message, data, request):
    """The same values as odxtools encodes them."""
    try:
        values = message.decode(data)
        known = {param.short_name for param in message.parameters if param.is_settable}
        values = {name: value for name, value in values.items() if name in known}
        if request is None:
            return bytes(message.encode(**values))
        return bytes(message.encode(coded_request=request, **values))
    except Exception:
        return None


def main():
    path, seed, rounds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    warnings.simplefilter("ignore")
    # odxtools reads on where a constant differs, which makes it another message.
    warnings.filterwarnings("error", message="Coded constant parameter does not match")
    logging.disable(logging.CRITICAL)
    rng = random.Random(seed)
    database = odxtools.load_file(path)
    layers = [*database.base_variants, *database.ecu_variants] if hasattr(database, "base_variants") else database.ecus
    for layer in layers:
        services = [service for service in layer.services if isinstance(service, DiagService)]
        codes = [dtc.trouble_code for dop in layer.diag_data_dictionary_spec.dtc_dops for dtc in dop.dtcs]
        for service in services:
            if service.request is None:
                continue
            for _ in range(rounds):
                request = made(service.request, None, codes, rng)
                if rng.randrange(2):
                    request = encoded(service.request, request, None) or request
                line = {"layer": layer.short_name, "service": service.short_name, "request": request.hex()}
                print(json.dumps({**line, "of_request": read(service.request, request)}))
                if read(service.request, request) is None:
                    continue
                for kind, responses in [("positive", service.positive_responses), ("negative", service.negative_responses)]:
                    for response in responses:
                        data = made(response, request, codes, rng)
                        if rng.randrange(2):
                            data = encoded(response, data, request) or data
                        readings = [read(one, data) for one in responses]
                        print(json.dumps({**line, "kind": kind, "data": data.hex(), "of_responses": readings}))


main()
