/* A client for cantap's wire protocol on one page, written from docs/wire-protocol.md. C99 and POSIX:
 *
 *     cc -std=c99 -Wall -Wextra -O2 -o cantap_client cantap_client.c
 *
 *     cantap_client PORT [BITRATE [SECONDS]]   sends a frame on channel 1, awaits its confirmation, captures; then the books
 *     cantap_client --decode FILE              prints what a device's byte stream says
 */
#define _DEFAULT_SOURCE
#include <fcntl.h>
#include <inttypes.h>
#include <poll.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { PROTOCOL = 7, MAX_MESSAGE = 2048, MAX_ENCODED = MAX_MESSAGE + 4 + 9 + 1, HELLO = 0, OWN_TAG = 7 };

static const char *const REPLIES[] = {"Hello", "Done", "Opened", "Status", "Time", "Filters", "Queued", "Registers", "Defaults",
                                      "Failures", "Edges", "Gateway", "GatewayRule"};
static const char *const REFUSALS[] = {"Protocol", "Malformed", "NoSession", "Unsupported", "BadTiming", "BadId", "BadDlc",
                                       "BadTag", "BadEntry", "BadSlot", "ChannelOpen", "ChannelClosed", "ListenOnly", "QueueFull",
                                       "BanksExhausted", "WouldDisturb", "TooFarAhead", "Hardware", "NothingSaved", "NotBusOff",
                                       "NotMeasuring", "NotGranted", "Held", "OtherSettings", "NoBoard",
                                       "NotNormal", "GatewayRunning", "DisturbanceLocked", "TooOften", "TooLate"};
static const char *const STAGES[] = {"controller", "queue", "link", "host", "gateway"};
static const char *const ERRORS[] = {"stuff", "form", "acknowledgment", "bit-recessive", "bit-dominant", "crc"};
static const char *const STATES[] = {"active", "warning", "passive", "bus-off"};
static const char *const FAILURES[] = {"arbitration-lost", "bus-error", "aborted", "closed", "bus-off", "overtaken", "loop"};
static const char *const ENDS[] = {"suspended", "board-lost", "server-ended", "configured"};

/* The name of a number, or "?" for one that this protocol version does not have. */
#define NAME(names, index) ((index) < sizeof(names) / sizeof *(names) ? (names)[index] : "?")

/* ---- Values. A reader that runs out of bytes says so at its end, once. ---- */

typedef struct { const uint8_t *at, *end; bool ok; } Reader;

static const uint8_t *take(Reader *m, size_t count) {
    static const uint8_t nothing[16];
    if ((size_t)(m->end - m->at) < count) { m->ok = false; m->at = m->end; return nothing; }
    m->at += count;
    return m->at - count;
}
static uint8_t byte(Reader *m) { return *take(m, 1); }
static uint64_t number(Reader *m) {
    uint64_t value = 0;
    for (int shift = 0; shift < 64; shift += 7) {
        uint8_t part = byte(m);
        value |= (uint64_t)(part & 127) << shift;
        if (part < 128) return value;
    }
    m->ok = false;
    return 0;
}
static uint64_t zigzag(Reader *m) { uint64_t value = number(m); return value >> 1 ^ -(value & 1); }

static size_t put(uint8_t *out, uint64_t value) {
    size_t len = 0;
    for (; value > 127; value >>= 7) out[len++] = (uint8_t)(value & 127) | 128;
    out[len++] = (uint8_t)value;
    return len;
}

/* ---- Framing: CRC-32, COBS, a zero. ---- */

static uint32_t crc32(const uint8_t *bytes, size_t len) {
    uint32_t crc = 0xFFFFFFFF;
    while (len--) {
        crc ^= *bytes++;
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320 : 0);
    }
    return ~crc;
}

/* `message` has room for four more bytes, and `out` for that plus one byte in 254 and two. */
static size_t seal(uint8_t *message, size_t len, uint8_t *out) {
    uint32_t crc = crc32(message, len);
    for (int i = 0; i < 4; i++) message[len++] = (uint8_t)(crc >> 8 * i);
    size_t code = 0, end = 1;
    for (size_t i = 0; i < len; i++) {
        if (message[i] != 0) out[end++] = message[i];
        bool full = end - code == 255;
        if (message[i] == 0 || (full && i + 1 < len)) { out[code] = (uint8_t)(end - code); code = end++; }
    }
    out[code] = (uint8_t)(end - code);
    out[end++] = 0;
    return end;
}

/* The length of the message between two zeros, decoded into `out`, or -1. */
static long unseal(const uint8_t *in, size_t len, uint8_t *out) {
    size_t at = 0, end = 0;
    while (at < len) {
        size_t run = in[at];
        if (at + run > len) return -1;
        memcpy(out + end, in + at + 1, run - 1);
        end += run - 1;
        at += run;
        if (run < 255 && at < len) out[end++] = 0;
    }
    if (end < 4) return -1;
    uint32_t crc = crc32(out, end -= 4);
    for (int i = 0; i < 4; i++) if (out[end + i] != (uint8_t)(crc >> 8 * i)) return -1;
    return (long)end;
}

/* ---- What a device says. ---- */

static uint32_t sequence, frames[2], lost[2], confirmed, answered; /* `answered`: id and 1, of the last response */
static bool refused, stopped, ended;
static uint8_t reply_bytes[MAX_ENCODED];
static Reader reply; /* its fields */

static void show_frame(FILE *out, uint32_t id, bool extended, unsigned dlc, bool remote, bool omitted, const uint8_t *data,
                       size_t len) {
    fprintf(out, extended ? " %08" PRIX32 " %u" : " %03" PRIX32 " %u", id, dlc);
    if (remote || omitted) fputs(remote ? " remote" : " no-data", out);
    else for (size_t i = 0; i < len; i++) fprintf(out, i ? "%02x" : " %02x", data[i]);
}

static uint64_t frame_record(uint8_t qualifiers, uint8_t head, Reader *m, uint64_t ticks) {
    bool extended = head & 0x20, remote = head & 0x10;
    unsigned channel = head >> 6 & 1, dlc = head & 15;
    const uint8_t *raw = take(m, extended ? 4 : 2);
    uint32_t id = raw[0] | (uint32_t)raw[1] << 8;
    if (extended) id |= (uint32_t)raw[2] << 16 | (uint32_t)raw[3] << 24;
    if (!(qualifiers & 2)) ticks += zigzag(m);
    size_t len = remote || qualifiers & 4 ? 0 : dlc < 8 ? dlc : 8;
    const uint8_t *data = take(m, len);
    if (!m->ok) return ticks;
    frames[channel]++;
    printf("%" PRIu64 " can%u", ticks, channel + 1);
    show_frame(stdout, id, extended, dlc, remote, qualifiers & 4, data, len);
    puts(qualifiers & 1 ? " upper-bound" : qualifiers & 2 ? " no-time" : "");
    return ticks;
}

static uint64_t event_record(uint8_t index, Reader *m, uint64_t ticks) {
    static char text[160];
    FILE *out = fmemopen(text, sizeof text, "w"); /* the time follows the fields, but is printed before them */
    if (!out) abort();
    unsigned channel = 0;
    uint32_t losses = 0, confirmations = 0;
    uint64_t a, b, c;
    if (index != 8) fprintf(out, "can%u ", (channel = (unsigned)number(m) & 1) + 1);
    switch (index) {
    case 0:
        a = number(m), b = number(m), c = byte(m), losses = (uint32_t)b;
        fprintf(out, "lost %s%" PRIu64 " %s", c ? "at-least " : "", b, NAME(STAGES, a));
        break;
    case 1: case 3:
        a = number(m), b = byte(m), c = byte(m);
        fprintf(out, index == 1 ? "error %s" : "state %s", index == 1 ? NAME(ERRORS, a) : NAME(STATES, a));
        fprintf(out, " tec %" PRIu64 " rec %" PRIu64, b, c);
        break;
    case 2: fprintf(out, "errors-suppressed %" PRIu64, number(m)); break;
    case 4: case 5: fputs(index == 4 ? "started" : "stopped", out); break;
    case 6: {
        a = number(m), b = number(m), c = byte(m), confirmations = a == OWN_TAG;
        size_t len = (size_t)number(m);
        fprintf(out, "sent tag %" PRIu64, a);
        show_frame(out, b & 0x1FFFFFFF, b >> 31 & 1, (unsigned)c, b >> 30 & 1, false, take(m, len), len < 8 ? len : 8);
        break;
    }
    case 7:
        a = number(m), b = number(m);
        fprintf(out, "not-sent tag %" PRIu64 " %s", a, NAME(FAILURES, b));
        if (b == 5) fprintf(out, " %" PRIu64, number(m));
        break;
    case 8: a = number(m), b = number(m); fprintf(out, "sof %" PRIu64 " doubled %" PRIu64, a, b); break;
    case 9: fprintf(out, "disturbed %" PRIu64, number(m)); break;
    default: m->ok = false; /* a record of a newer protocol: nothing after it can be read */
    }
    fclose(out);
    ticks += zigzag(m);
    if (!m->ok) return ticks;
    lost[channel] += losses, confirmed += confirmations, stopped |= index == 5 && channel == 0;
    printf("%" PRIu64 " %s\n", ticks, text);
    return ticks;
}

static void batch(Reader *m, bool last) {
    uint32_t reason = last ? (uint32_t)number(m) : 0;
    uint32_t told = (uint32_t)number(m), before[2], missing[2];
    uint64_t ticks = number(m);
    bool old = told - sequence > INT32_MAX;
    for (int i = 0; i < 2; i++) {
        before[i] = (uint32_t)number(m);
        missing[i] = before[i] - frames[i];
        old |= missing[i] > INT32_MAX;
    }
    if (!m->ok) { puts("unreadable"); return; }
    if (old) { puts("out of order"); return; } /* from an older session, or a repetition */
    if (missing[0] || missing[1]) printf("lost on the link %" PRIu32 " %" PRIu32 "\n", missing[0], missing[1]);
    for (int i = 0; i < 2; i++) lost[i] += missing[i], frames[i] = before[i];
    sequence = told + 1;
    if (last) { ended = true; printf("%" PRIu64 " session ended: %s\n", ticks, NAME(ENDS, reason)); }
    while (!last && m->ok && m->at < m->end) {
        uint8_t head = byte(m), qualifiers = 0;
        if (head >= 0x41 && head <= 0x46) qualifiers = head & 7, head = byte(m);
        ticks = head < 0x80 ? event_record(head, m, ticks) : frame_record(qualifiers, head, m, ticks);
    }
    if (!m->ok) puts("unreadable"); /* the next batch counts what is missing */
}

static void response(Reader *m) {
    unsigned id = (unsigned)number(m);
    refused = byte(m);
    unsigned index = (unsigned)number(m);
    if (!m->ok) { puts("unreadable"); return; }
    printf("response %u %s%s", id, refused ? "refused " : "", refused ? NAME(REFUSALS, index) : NAME(REPLIES, index));
    if (refused) for (int n = index == 14 ? 2 : index == 0 || index == 13 || index == 21; n > 0; n--) printf(" %" PRIu64, number(m));
    puts("");
    if (!refused && index == HELLO) sequence = frames[0] = frames[1] = lost[0] = lost[1] = 0;
    size_t len = (size_t)(m->end - m->at);
    memcpy(reply_bytes, m->at, len);
    reply = (Reader){reply_bytes, reply_bytes + len, true};
    answered = id + 1;
}

static void push(const uint8_t *bytes, size_t len) {
    static uint8_t partial[MAX_ENCODED], message[MAX_ENCODED];
    static size_t held;
    for (; len; len--, bytes++) {
        if (*bytes) {
            if (held < sizeof partial) partial[held] = *bytes;
            held += held < sizeof partial; /* what is too long has no good CRC */
            continue;
        }
        long size = held ? unseal(partial, held, message) : 0;
        bool empty = !held;
        held = 0;
        if (empty) continue;
        if (size < 0) { puts("damaged"); continue; }
        Reader m = {message, message + size, true};
        uint64_t kind = number(&m);
        if (kind == 1) response(&m);
        else if (kind == 0 || kind == 2) batch(&m, kind == 2);
        else puts("unreadable");
    }
}

/* ---- A host. ---- */

static int port;

static void fail(const char *why) { fprintf(stderr, "cantap_client: %s\n", why); exit(1); }
static double now(void) { struct timespec t; clock_gettime(CLOCK_MONOTONIC, &t); return (double)t.tv_sec + (double)t.tv_nsec / 1e9; }

static void receive(void) {
    static uint8_t bytes[65536];
    struct pollfd ready = {port, POLLIN, 0};
    if (poll(&ready, 1, 50) <= 0) return;
    ssize_t len = read(port, bytes, sizeof bytes);
    if (len <= 0) fail("the port is gone");
    push(bytes, (size_t)len);
}

/* Sends a command with its fields and waits for the response, whose fields are then in `reply`. */
static void ask(const uint8_t *command, size_t len) {
    static unsigned id;
    uint8_t request[128], encoded[140];
    size_t at = put(request, ++id);
    memcpy(request + at, command, len);
    at = seal(request, at + len, encoded);
    if (write(port, encoded, at) != (ssize_t)at) fail("the port takes nothing");
    for (double ends = now() + 2; answered != id + 1; receive()) if (now() > ends) fail("the device does not answer");
    if (refused) fail("the device refuses");
}

int main(int argc, char **argv) {
    if (argc == 3 && !strcmp(argv[1], "--decode")) {
        uint8_t bytes[4096];
        FILE *file = fopen(argv[2], "rb");
        if (!file) fail("cannot open the file");
        for (size_t len; (len = fread(bytes, 1, sizeof bytes, file)) > 0;) push(bytes, len);
        return 0;
    }
    if (argc < 2) fail("give a port, such as /dev/ttyACM0");
    unsigned bitrate = argc > 2 ? (unsigned)atoi(argv[2]) : 500000;
    double seconds = argc > 3 ? atof(argv[3]) : 2;
    port = open(argv[1], O_RDWR | O_NOCTTY); /* opening it raises DTR */
    struct termios raw;
    if (port < 0 || tcgetattr(port, &raw)) fail("cannot open the port");
    cfmakeraw(&raw);
    tcsetattr(port, TCSANOW, &raw);
    if (write(port, "", 1) != 1) fail("the port takes nothing"); /* a zero: ends an unfinished request, and chooses this protocol */

    ask((uint8_t[]){HELLO, PROTOCOL}, 2);
    for (int i = 0; i < 4; i++) number(&reply); /* protocol and firmware versions */
    size_t board_len = (size_t)number(&reply);
    const char *board = (const char *)take(&reply, board_len);
    size_t serial_len = (size_t)number(&reply);
    const char *serial = (const char *)take(&reply, serial_len);
    unsigned channels = byte(&reply), tick_hz = (unsigned)number(&reply), clock_hz = (unsigned)number(&reply);
    printf("board %.*s serial %.*s channels %u ticks/s %u\n", (int)board_len, board, (int)serial_len, serial, channels, tick_hz);

    unsigned quanta = 18; /* of a bit, the sample point near 87.5 % */
    while (quanta > 7 && clock_hz % (bitrate * quanta)) quanta--;
    if (quanta < 8 || clock_hz / (bitrate * quanta) > 1024) fail("the CAN clock does not reach this bit rate");
    uint8_t segment2 = (uint8_t)(quanta / 8), normal = 1; /* acknowledges and sends; 0 only listens */
    uint8_t open_command[16] = {1, 0, 1};
    size_t len = 3 + put(open_command + 3, clock_hz / (bitrate * quanta));
    memcpy(open_command + len, (uint8_t[]){(uint8_t)(quanta - 1 - segment2), segment2, 1, normal, 0, 0, 0, 0}, 8);
    ask(open_command, len + 8);
    /* One frame, identifier 123, two bytes, at once. */
    ask((uint8_t[]){6, 0, 1, OWN_TAG, 0xA3, 0x02, 2, 2, 0x11, 0x22, 0}, 11);
    for (double ends = now() + seconds; now() < ends && !ended;) receive();
    /* Responses overtake records: all of them have arrived once `Stopped` has. */
    ask((uint8_t[]){2, 0}, 2);
    while (!stopped) receive();
    ask((uint8_t[]){3}, 1);
    for (int i = 0; i < 4; i++) number(&reply);  /* ticks, queue fill, highest fill, bad requests */
    for (int i = 0; i < 2; i++) if (byte(&reply)) number(&reply); /* temperature, supply */
    take(&reply, 4);                             /* not open; state and error counters */
    if (byte(&reply)) number(&reply);            /* the last error */
    unsigned taken = (unsigned)number(&reply), overruns = (unsigned)number(&reply);
    printf("frames %" PRIu32 " lost %" PRIu32 " taken %u overruns %u confirmed %" PRIu32 "\n", frames[0], lost[0], taken, overruns,
           confirmed);
    return frames[0] + lost[0] == taken + overruns && confirmed == 1 ? 0 : 1;
}
