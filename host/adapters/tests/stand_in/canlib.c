/* A library with the functions of Kvaser's canlib.h: an adapter as channel 0, a virtual channel as channel 1. */
#include <pthread.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

enum { OK = 0, PARAM = -1, NOMSG = -2, INVHANDLE = -10, TXBUFOFL = -13, HARDWARE = -15, NO_ACCESS = -31 };

typedef struct { long id; unsigned len, flags; unsigned long time; uint8_t data[64]; } Message;

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static Message queue[4096];
static unsigned head, tail, sent_count, room = 64, last_sent, last_flags, last_len, output = 4, bits, transmit_acknowledge, scale = 1000;
static int open_handle, on_bus, unplugged, deaf, occupied, babbles;
static volatile int hangs;
static unsigned babbled;
static long bitrate, data_bitrate;
static unsigned segments[3];

static uint64_t began_us;

static uint64_t now_us(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000 + (uint64_t)now.tv_nsec / 1000;
}

/* What the test wants of a library in another process: it talks, vanishes meanwhile, acknowledges whatever it is told, refuses, or counts channels
   that are not there. */
static int is(const char *way) {
    const char *wanted = getenv("STANDIN");
    return wanted && !strcmp(wanted, way);
}

/* A hundred messages, one each millisecond: standard and extended in turn. */
static void talk(void) {
    if (!is("talks") && !is("vanishes")) return;
    began_us = now_us();
    for (unsigned i = 0; i < 100; i++) {
        Message m = { .id = (long)(i % 2 ? 0x18DA0000 + i : 0x100 + i), .len = i % 9, .flags = i % 2 ? 4 : 2, .time = 1000 * i };
        memset(m.data, (int)i, sizeof m.data);
        queue[head++ % 4096] = m;
    }
}

void canInitializeLibrary(void) {}
int canGetNumberOfChannels(int *count) {
    if (is("refuses")) return HARDWARE;
    *count = is("lies") ? 2000000000 : 2;
    return OK;
}

int canGetChannelData(int channel, int item, void *buffer, size_t len) {
    if (channel < 0 || channel > 1) return PARAM;
    memset(buffer, 0, len);
    if (item == 13) strncpy(buffer, channel ? "Kvaser Virtual CAN Driver (channel 0)" : "Kvaser Leaf Light v2 (channel 0)", len);
    if (item == 1) { uint32_t can = channel ? 0x90000 : 0x80001; memcpy(buffer, &can, 4); }
    if (item == 7) { uint64_t serial = channel ? 0 : 12345; memcpy(buffer, &serial, 8); }
    return OK;
}

int canOpenChannel(int channel, int flags) {
    if (channel > 1 || !(flags & 0x20)) return -3;
    if (occupied) return NO_ACCESS;
    open_handle = 1;
    head = tail = 0;
    output = 4;
    return 7;
}

static int check(int handle) { return unplugged ? HARDWARE : handle == 7 && open_handle ? OK : INVHANDLE; }
int canClose(int handle) { int status = check(handle); open_handle = on_bus = 0; return status; }
int canBusOn(int handle) { int status = check(handle); if (!status) { on_bus = 1; talk(); } return status; }
int canBusOff(int handle) { int status = check(handle); on_bus = 0; return status; }

int canSetBusParams(int handle, long rate, unsigned s1, unsigned s2, unsigned sjw, unsigned samples, unsigned mode) {
    (void)mode;
    if (samples != 1 || rate <= 0) return PARAM;
    bitrate = rate;
    segments[0] = s1; segments[1] = s2; segments[2] = sjw;
    return check(handle);
}

int canSetBusParamsFd(int handle, long rate, unsigned s1, unsigned s2, unsigned sjw) {
    (void)s1; (void)s2; (void)sjw;
    data_bitrate = rate;
    return check(handle);
}

int canSetBusOutputControl(int handle, unsigned type) { if (!deaf && !is("acknowledges")) output = type; return check(handle); }
int canGetBusOutputControl(int handle, unsigned *type) { *type = output; return check(handle); }

int canIoCtl(int handle, unsigned function, void *buffer, unsigned len) {
    if (len < 4) return PARAM;
    if (function == 7) memcpy(&transmit_acknowledge, buffer, 4);
    if (function == 6) memcpy(&scale, buffer, 4);
    return check(handle);
}

int canRead(int handle, long *id, void *data, unsigned *len, unsigned *flags, unsigned long *time) {
    int status = check(handle);
    if (status) return status;
    while (hangs) usleep(1000);
    pthread_mutex_lock(&lock);
    if (babbles) {
        /* A frame, and something with a length that no frame has, in turn. */
        *id = (long)(babbled % 0x700); *len = babbled & 1 ? 77 : 0; *flags = 2; *time = now_us() / scale;
        babbled++;
    } else if (head == tail || (began_us && began_us + queue[tail % 4096].time > now_us())) {
        status = NOMSG;
    } else {
        Message *m = &queue[tail++ % 4096];
        *id = m->id; *len = m->len; *flags = m->flags; *time = m->time / scale;
        memcpy(data, m->data, m->flags & 0x10000 ? 64 : 8);
        if (tail == 50 && is("vanishes")) unplugged = 1;
    }
    pthread_mutex_unlock(&lock);
    return status;
}

int canWrite(int handle, long id, void *data, unsigned len, unsigned flags) {
    int status = check(handle);
    if (status) return status;
    if (!on_bus) return PARAM;
    pthread_mutex_lock(&lock);
    if (sent_count >= room) {
        status = TXBUFOFL;
    } else {
        last_sent = (unsigned)id; last_flags = flags; last_len = len;
        sent_count++;
        if (transmit_acknowledge) {
            Message m = { .id = id, .len = len, .flags = flags | 0x40, .time = 5000000 + 1000 * sent_count };
            unsigned most = flags & 0x10000 ? 64 : 8;
            memcpy(m.data, data, len > most ? most : len);
            queue[head++ % 4096] = m;
        }
    }
    pthread_mutex_unlock(&lock);
    return status;
}

int canRequestChipStatus(int handle) { return check(handle); }
int canReadStatus(int handle, unsigned long *flags) { *flags = bits; return check(handle); }

int canReadErrorCounters(int handle, unsigned *tx, unsigned *rx, unsigned *overruns) {
    *tx = bits & 1 ? 130 : 3; *rx = 1000; *overruns = 0;
    return check(handle);
}

int canGetErrorText(int error, char *text, unsigned len) {
    strncpy(text, error == HARDWARE ? "Hardware error" : "Some error", len);
    return OK;
}

/* For the test. */
void standin_receive(uint32_t id, uint32_t flags, uint32_t len, const uint8_t *data, uint64_t us) {
    Message m = { .id = id, .len = len, .flags = flags, .time = us };
    memcpy(m.data, data, 64);
    pthread_mutex_lock(&lock);
    queue[head++ % 4096] = m;
    pthread_mutex_unlock(&lock);
}

void standin_set(uint32_t what, uint32_t value) {
    switch (what) {
        case 0: bits = value; break;
        case 2: unplugged = (int)value; break;
        case 3: deaf = (int)value; break; /* to the wish to be silent */
        case 5: occupied = (int)value; break;
        case 7: room = value; break;
        case 8: babbles = (int)value; break;
        case 9: hangs = (int)value; break; /* in a read, until it is told otherwise */
    }
}

/* What was sent, the bit rates, whether it is on the bus, how it drives it. */
uint32_t standin_get(uint32_t what) {
    switch (what) {
        case 0: return sent_count;
        case 1: return (uint32_t)bitrate;
        case 2: return (uint32_t)on_bus;
        case 3: return output;
        case 4: return last_sent;
        case 5: return (uint32_t)data_bitrate;
        case 6: return last_flags;
        case 7: return last_len;
        default: return segments[0] << 16 | segments[1] << 8 | segments[2];
    }
}
