/* A disk and a clock that fail on demand: preloaded into the service, its workers and commands (LD_PRELOAD).
 *
 * FAULTS_CONTROL names a file of eight 64-bit numbers, which every process maps, so that a change takes effect at once
 * in all of them (`tests/faults/shim.py` has their names). Only files under FAULTS_FOLDER are affected. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum { WRITE_ERROR, SYNC_ERROR, OPEN_ERROR, WRITE_US, SYNC_US, CLOCK_NS, NUMBERS = 8 };

static volatile int64_t none[NUMBERS];
static volatile int64_t *control = none;
static const char *folder = "/";

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

__attribute__((constructor)) static void begin(void) {
    const char *file = getenv("FAULTS_CONTROL");
    if (getenv("FAULTS_FOLDER")) folder = getenv("FAULTS_FOLDER");
    int handle = file ? (int)REAL(open)(file, O_RDONLY | O_CLOEXEC) : -1;
    if (handle < 0) return;
    void *mapped = mmap(0, NUMBERS * sizeof(int64_t), PROT_READ, MAP_SHARED, handle, 0);
    if (mapped != MAP_FAILED) control = mapped;
    close(handle);
}

static int ours(int handle) {
    char link[40], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", handle);
    ssize_t length = readlink(link, path, sizeof path - 1);
    return length > 0 && !strncmp(path, folder, strlen(folder));
}

/* Wait as long as a slow disk does, and return whether the call is to fail. */
static int fails(int handle, int error, int delay) {
    if ((!control[error] && !control[delay]) || !ours(handle)) return 0;
    if (control[delay]) usleep((useconds_t)control[delay]);
    errno = (int)control[error];
    return control[error] != 0;
}

#define WRITING(type, name, parameters, handle, arguments) \
    type name parameters { return fails(handle, WRITE_ERROR, WRITE_US) ? -1 : REAL(name) arguments; }
#define SYNCING(name) \
    int name(int handle) { return fails(handle, SYNC_ERROR, SYNC_US) ? -1 : REAL(name)(handle); }

WRITING(ssize_t, write, (int handle, const void *data, size_t size), handle, (handle, data, size))
WRITING(ssize_t, writev, (int handle, const struct iovec *data, int count), handle, (handle, data, count))
WRITING(ssize_t, pwrite, (int handle, const void *data, size_t size, off_t at), handle, (handle, data, size, at))
WRITING(ssize_t, pwrite64, (int handle, const void *data, size_t size, off64_t at), handle, (handle, data, size, at))
WRITING(int, ftruncate, (int handle, off_t size), handle, (handle, size))
WRITING(int, ftruncate64, (int handle, off64_t size), handle, (handle, size))
SYNCING(fsync)
SYNCING(fdatasync)

/* As on a file system that was remounted read-only: files can be opened for reading only. */
static int refused(int at, const char *path, int flags) {
    char full[4096] = "", link[40];
    if (!control[OPEN_ERROR] || !(flags & (O_WRONLY | O_RDWR | O_CREAT | O_TRUNC))) return 0;
    if (path[0] != '/') {
        snprintf(link, sizeof link, at == AT_FDCWD ? "/proc/self/cwd" : "/proc/self/fd/%d", at);
        if (readlink(link, full, sizeof full - 1) < 0) return 0;
        path = full;
    }
    errno = (int)control[OPEN_ERROR];
    return !strncmp(path, folder, strlen(folder));
}

#define OPENING(name) \
    int name(const char *path, int flags, ...) { \
        va_list more; va_start(more, flags); mode_t mode = va_arg(more, mode_t); va_end(more); \
        return refused(AT_FDCWD, path, flags) ? -1 : REAL(name)(path, flags, mode); \
    }
#define OPENING_AT(name) \
    int name(int at, const char *path, int flags, ...) { \
        va_list more; va_start(more, flags); mode_t mode = va_arg(more, mode_t); va_end(more); \
        return refused(at, path, flags) ? -1 : REAL(name)(at, path, flags, mode); \
    }
OPENING(open)
OPENING(open64)
OPENING_AT(openat)
OPENING_AT(openat64)

int clock_gettime(clockid_t which, struct timespec *now) {
    int answer = REAL(clock_gettime)(which, now);
    if (!answer && control[CLOCK_NS] && (which == CLOCK_REALTIME || which == CLOCK_REALTIME_COARSE)) {
        int64_t shifted_ns = now->tv_sec * 1000000000LL + now->tv_nsec + control[CLOCK_NS];
        now->tv_sec = shifted_ns / 1000000000LL;
        now->tv_nsec = shifted_ns % 1000000000LL;
    }
    return answer;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec shifted;
    (void)zone;
    if (clock_gettime(CLOCK_REALTIME, &shifted)) return -1;
    now->tv_sec = shifted.tv_sec;
    now->tv_usec = shifted.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *into) {
    struct timespec shifted;
    clock_gettime(CLOCK_REALTIME, &shifted);
    if (into) *into = shifted.tv_sec;
    return shifted.tv_sec;
}
