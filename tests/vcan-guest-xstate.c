/* Lets User Mode Linux run on processors with AMX.

   It keeps the vector registers of its processes by PTRACE_GETREGSET and PTRACE_SETREGSET, in a buffer made before there
   was AMX. The host gives it what fits, but takes only a whole buffer back (EFAULT). Preloaded, this fills up what UML
   sets with what the host has. The tiles of AMX themselves are not kept; a guest that does not know them uses none. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>
#include <sys/types.h>
#include <sys/uio.h>

enum { GET = 0x4204, SET = 0x4205, XSTATE = 0x202, HEADER = 512 };
static const uint64_t TILES = UINT64_C(3) << 17; /* bits of XSTATE_BV */
static unsigned char whole[1 << 16] __attribute__((aligned(64)));

long ptrace(int request, ...)
{
    static long (*host)(int, pid_t, void *, void *);
    va_list rest;
    va_start(rest, request);
    pid_t pid = va_arg(rest, pid_t);
    void *address = va_arg(rest, void *), *data = va_arg(rest, void *);
    va_end(rest);
    if (!host)
        host = (long (*)(int, pid_t, void *, void *))dlsym(RTLD_NEXT, "ptrace");
    if ((request != GET && request != SET) || (uintptr_t)address != XSTATE)
        return host(request, pid, address, data);
    struct iovec *part = data, all = {whole, sizeof whole};
    long result = host(GET, pid, address, &all);
    if (result)
        return result;
    size_t length = part->iov_len < all.iov_len ? part->iov_len : all.iov_len;
    if (request == GET) {
        memcpy(part->iov_base, whole, length);
        part->iov_len = length;
        return 0;
    }
    memcpy(whole, part->iov_base, length);
    uint64_t held;
    memcpy(&held, whole + HEADER, sizeof held);
    held &= ~TILES;
    memcpy(whole + HEADER, &held, sizeof held);
    return host(SET, pid, address, &all);
}
