/* A library with the functions of PEAK's PCANBasic.h, and one adapter: PCAN_USBBUS1. What it does is said by the functions at the end. */
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define OK 0
#define QRCVEMPTY 0x20
#define QXMTFULL 0x80
#define HWINUSE 0x400
#define ILLHW 0x1400
#define ILLPARAMTYPE 0x4000
#define INITIALIZE 0x4000000
#define USBBUS1 0x51

typedef struct { uint32_t id; uint8_t type, len, data[8]; } Msg;
typedef struct { uint32_t millis; uint16_t overflow, micros; } Stamp;
typedef struct { uint32_t id; uint8_t type, dlc, data[64]; } MsgFd;

typedef struct { uint16_t channel; uint8_t device, controller; uint32_t features; char name[33]; uint32_t id, condition; } Information;

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static struct { MsgFd msg; uint64_t us; } queue[4096];
static unsigned head, tail;
static MsgFd sent[64];
static unsigned sent_count, room = 64;
static uint32_t values[256], bus_status, read_status;
static int initialized, unplugged, deaf, knows_echoes = 1, occupied, babbles;
static volatile int hangs;
static unsigned babbled;
static char timing[512];
static uint16_t registers;

static void put(const MsgFd *msg, uint64_t us) {
    queue[head % 4096].msg = *msg;
    queue[head++ % 4096].us = us;
}

/* What the test wants of a library in another process: it talks, vanishes meanwhile, acknowledges whatever it is
   told, hangs, dies, is old, or counts channels that are not there. */
static int is(const char *way) {
    const char *wanted = getenv("STANDIN");
    return wanted && !strcmp(wanted, way);
}

static uint64_t now_us(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000 + (uint64_t)now.tv_nsec / 1000;
}

static uint64_t began_us;

/* A hundred messages, one each millisecond: standard and extended in turn, or with 64 bytes. */
static void talk(int fd) {
    began_us = now_us();
    for (unsigned i = 0; i < 100; i++) {
        MsgFd msg = { .id = i % 2 ? 0x18DA0000 + i : 0x100 + i, .type = i % 2 ? 2 : 0, .dlc = (uint8_t)(i % 9) };
        if (fd) { msg.type |= 0x0C; msg.dlc = 15; }
        memset(msg.data, (int)i, sizeof msg.data);
        put(&msg, 1000 * i);
    }
}

static uint32_t begin(uint16_t channel, int fd) {
    if (channel != USBBUS1 || unplugged) return ILLHW;
    if (initialized) return INITIALIZE;
    if (occupied == 2) return HWINUSE;
    initialized = 1;
    head = tail = 0;
    if (is("talks") || is("vanishes")) talk(fd);
    return OK;
}

uint32_t CAN_Initialize(uint16_t channel, uint16_t btr0btr1, uint8_t type, uint32_t port, uint16_t irq) {
    (void)type; (void)port; (void)irq;
    registers = btr0btr1;
    return begin(channel, 0);
}

uint32_t CAN_InitializeFD(uint16_t channel, const char *text) {
    strncpy(timing, text, sizeof timing - 1);
    return begin(channel, 1);
}

uint32_t CAN_Uninitialize(uint16_t channel) {
    if (channel != USBBUS1) return ILLHW;
    uint32_t status = initialized ? OK : INITIALIZE;
    initialized = 0;
    values[8] = 0;
    return status;
}

uint32_t CAN_GetStatus(uint16_t channel) {
    if (channel != USBBUS1 || unplugged) return ILLHW;
    return initialized ? bus_status : INITIALIZE;
}

static uint32_t next(uint16_t channel, MsgFd *msg, uint64_t *us) {
    if (channel != USBBUS1 || unplugged) return ILLHW;
    if (!initialized) return INITIALIZE;
    while (hangs) usleep(1000);
    pthread_mutex_lock(&lock);
    uint32_t status = read_status;
    read_status = 0;
    if (babbles) {
        /* A frame, and something with a length that no frame has, in turn. */
        *msg = (MsgFd){ .id = babbled % 0x700, .dlc = babbled & 1 ? 77 : 0 };
        *us = now_us();
        babbled++;
        pthread_mutex_unlock(&lock);
        return OK;
    }
    if (!status && (head == tail || (began_us && began_us + queue[tail % 4096].us > now_us()))) status = QRCVEMPTY;
    if (!status) { *msg = queue[tail % 4096].msg; *us = queue[tail++ % 4096].us; }
    if (tail == 50 && is("vanishes")) unplugged = 1;
    pthread_mutex_unlock(&lock);
    return status;
}

uint32_t CAN_Read(uint16_t channel, Msg *msg, Stamp *stamp) {
    MsgFd fd;
    uint64_t us = 0;
    uint32_t status = next(channel, &fd, &us);
    if (status) return status;
    msg->id = fd.id; msg->type = fd.type; msg->len = fd.dlc;
    memcpy(msg->data, fd.data, 8);
    uint64_t millis = us / 1000;
    stamp->millis = (uint32_t)millis; stamp->overflow = (uint16_t)(millis >> 32); stamp->micros = us % 1000;
    return OK;
}

uint32_t CAN_ReadFD(uint16_t channel, MsgFd *msg, uint64_t *us) { return next(channel, msg, us); }

static uint32_t transmit(uint16_t channel, const MsgFd *msg) {
    if (channel != USBBUS1 || unplugged) return ILLHW;
    if (!initialized) return INITIALIZE;
    pthread_mutex_lock(&lock);
    uint32_t status = OK;
    if (sent_count >= room) {
        status = QXMTFULL;
    } else {
        sent[sent_count++] = *msg;
        if (values[0x2C]) {
            MsgFd echo = *msg;
            echo.type |= 0x20;
            put(&echo, 5000000 + 1000 * sent_count);
        }
    }
    pthread_mutex_unlock(&lock);
    return status;
}

uint32_t CAN_Write(uint16_t channel, Msg *msg) {
    MsgFd fd = { .id = msg->id, .type = msg->type, .dlc = msg->len };
    memcpy(fd.data, msg->data, 8);
    return transmit(channel, &fd);
}

uint32_t CAN_WriteFD(uint16_t channel, MsgFd *msg) { return transmit(channel, msg); }

static uint32_t attached(uint8_t parameter, void *buffer, uint32_t len) {
    const Information all[] = {
        { USBBUS1, 5, 0, is("talks") ? 1 : values[0x16], "PCAN-USB FD", 0x2A, occupied == 1 ? 2 : 1 },
        { 0x52, 5, 1, 1, "PCAN-USB Pro FD\033[2J", 7, 2 },
        { USBBUS1, 5, 0, 0, "again", 0, 1 },
        { 0x31, 1, 0, 0, "a parallel port's", 0, 1 },
    };
    if (is("hangs")) for (;;) sleep(1);
    if (is("dies")) abort();
    if (is("is old")) return ILLPARAMTYPE;
    uint32_t count = sizeof all / sizeof *all;
    if (parameter == 0x2A) { uint32_t told = is("lies") ? 0xFFFFFFFF : count; memcpy(buffer, &told, 4); return OK; }
    memcpy(buffer, all, len < sizeof all ? len : sizeof all);
    /* A name without an end. */
    if (is("lies")) for (uint32_t at = sizeof all; at + sizeof *all <= len; at += sizeof *all) memset((char *)buffer + at, 0x51, sizeof *all);
    return OK;
}

uint32_t CAN_GetValue(uint16_t channel, uint8_t parameter, void *buffer, uint32_t len) {
    if (!channel && (parameter == 0x2A || parameter == 0x2B)) return attached(parameter, buffer, len);
    if (parameter == 0x0D) { /* channel condition */
        uint32_t condition = channel == USBBUS1 && !unplugged ? (occupied == 1 ? 2 : 1) : 0;
        memcpy(buffer, &condition, 4);
        return OK;
    }
    if (channel != USBBUS1 || unplugged) return ILLHW;
    if (parameter == 0x0E) { /* hardware name, without an end if there is no room for one */
        strncpy(buffer, "PCAN-USB FD", len);
        return OK;
    }
    uint32_t value = parameter == 0x16 && is("talks") ? 1 : values[parameter];
    memcpy(buffer, &value, 4);
    return OK;
}

uint32_t CAN_SetValue(uint16_t channel, uint8_t parameter, void *buffer, uint32_t len) {
    (void)len;
    if (channel != USBBUS1 || unplugged) return ILLHW;
    if (parameter == 0x2C && !knows_echoes) return ILLPARAMTYPE;
    if (parameter == 0x08 && (deaf || is("acknowledges"))) return OK;
    memcpy(&values[parameter], buffer, 4);
    return OK;
}

uint32_t CAN_GetErrorText(uint32_t error, uint16_t language, char *text) {
    (void)language;
    strcpy(text, error == ILLHW ? "A hardware handle is invalid" : "An unknown error");
    return OK;
}

/* For the test. */
void standin_receive(uint32_t id, uint32_t type, uint32_t dlc, const uint8_t *data, uint64_t us) {
    MsgFd msg = { .id = id, .type = (uint8_t)type, .dlc = (uint8_t)dlc };
    memcpy(msg.data, data, 64);
    pthread_mutex_lock(&lock);
    put(&msg, us);
    pthread_mutex_unlock(&lock);
}

void standin_set(uint32_t what, uint32_t value) {
    pthread_mutex_lock(&lock);
    switch (what) {
        case 0: bus_status = value; break;
        case 1: read_status = value; break;
        case 2: unplugged = (int)value; break;
        case 3: deaf = (int)value; break;          /* to the wish to be silent */
        case 4: knows_echoes = (int)value; break;
        case 5: occupied = (int)value; break;      /* 1: visibly, 2: when it is opened */
        case 6: values[0x16] = value; break;       /* features */
        case 7: room = value; break;
        case 8: babbles = (int)value; break;
        case 9: hangs = (int)value; break;         /* in a read, until it is told otherwise */
    }
    pthread_mutex_unlock(&lock);
}

/* What was sent, registers, whether it is on the bus, whether it is silent. */
uint32_t standin_get(uint32_t what) {
    switch (what) {
        case 0: return sent_count;
        case 1: return registers;
        case 2: return (uint32_t)initialized;
        case 3: return values[8];
        case 5: return 0;
        case 6: return sent_count ? sent[sent_count - 1].type : 0;
        case 7: return sent_count ? sent[sent_count - 1].dlc : 0;
        default: return sent_count ? sent[sent_count - 1].id : 0;
    }
}
