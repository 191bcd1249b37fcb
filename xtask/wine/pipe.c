/* Stands in for Wireshark: makes a named pipe, and writes what comes through it to a file. */
#include <stdio.h>
#include <windows.h>
int main(int argc, char **argv) {
    if (argc != 3) return 2;
    HANDLE pipe = CreateNamedPipeA(argv[1], PIPE_ACCESS_DUPLEX, PIPE_TYPE_BYTE | PIPE_WAIT, 1, 65536, 65536, 0, NULL);
    if (pipe == INVALID_HANDLE_VALUE) return 3;
    if (!ConnectNamedPipe(pipe, NULL) && GetLastError() != ERROR_PIPE_CONNECTED) return 4;
    FILE *out = fopen(argv[2], "wb");
    if (!out) return 5;
    char bytes[65536];
    DWORD count;
    while (ReadFile(pipe, bytes, sizeof bytes, &count, NULL) && count) { fwrite(bytes, 1, count, out); fflush(out); }
    return fclose(out) ? 6 : 0;
}
