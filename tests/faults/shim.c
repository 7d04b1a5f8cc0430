/* Fails calls of the C library on files below one folder, for the tests of faults.
 *
 * FAULT_FOLDER  paths below it are concerned; FAULT_KIND  count, enospc, eio, eioread, short, erofs, clock;
 * FAULT_NTH     the call, counted over all processes, that is the first to fail;
 * FAULT_COUNTS  a file of three 64-bit counters: reads, changes (writes, names), clock readings.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/time.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

enum { READS, CHANGES, CLOCKS };
static const char *folder, *kind = "";
static long nth;
static _Atomic long *counts;

__attribute__((constructor)) static void prepare(void) {
    const char *file = getenv("FAULT_COUNTS"), *n = getenv("FAULT_NTH");
    if (!file) return;
    int fd = (int)((long (*)(const char *, int, ...))dlsym(RTLD_NEXT, "open"))(file, O_RDWR);
    void *map = fd < 0 ? MAP_FAILED : mmap(NULL, 24, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (fd >= 0) close(fd);
    if (map == MAP_FAILED) return;
    nth = n ? atol(n) : 0;
    kind = getenv("FAULT_KIND") ? getenv("FAULT_KIND") : "";
    folder = getenv("FAULT_FOLDER");
    counts = map;
}

static int is(const char *name) { return strcmp(kind, name) == 0; }
static int below(const char *path) {
    size_t n = folder ? strlen(folder) : 0;
    return n && strncmp(path, folder, n) == 0 && (path[n] == '/' || path[n] == 0);
}
static int fd_below(int fd) {
    char link[64], path[PATH_MAX];
    int kept = errno;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = counts ? readlink(link, path, sizeof path - 1) : -1;
    errno = kept;
    if (n < 0) return 0;
    path[n] = 0;
    return below(path);
}
static int name_below(int dir, const char *path) {
    char whole[PATH_MAX];
    if (!counts || !path) return 0;
    if (path[0] == '/') return below(path);
    if (dir != AT_FDCWD) return fd_below(dir);
    if (!getcwd(whole, sizeof whole / 2)) return 0;
    return below(whole);
}
/* Count a call; return the number of the error it fails with, or 0. */
static int change(int is_name) {
    long now = atomic_fetch_add(&counts[CHANGES], 1) + 1;
    if (now >= nth && is("enospc")) return ENOSPC;
    if (now == nth && is("eio")) return EIO;
    if (now >= nth && is_name && is("erofs")) return EROFS;
    return 0;
}
static size_t shorter(size_t n, int what) {
    return is("short") && n > 1 && counts[what] % 3 == nth % 3 ? n / 2 + 1 : n;
}
static int reading(void) {
    return atomic_fetch_add(&counts[READS], 1) + 1 == nth && is("eioread") ? EIO : 0;
}

#define REAL(type, name, ...) static type (*real)(__VA_ARGS__); if (!real) real = dlsym(RTLD_NEXT, name)
#define CHANGE(concerned, is_name) \
    if (concerned) { int error = change(is_name); if (error) { errno = error; return -1; } }

#define DATA(name, what, gate, buffer) \
    ssize_t name(int fd, buffer b, size_t n) { \
        REAL(ssize_t, #name, int, buffer, size_t); \
        if (fd_below(fd)) { int e = gate; if (e) { errno = e; return -1; } n = shorter(n, what); } \
        return real(fd, b, n); \
    }
#define PDATA(name, what, gate, buffer) \
    ssize_t name(int fd, buffer b, size_t n, off_t at) { \
        REAL(ssize_t, #name, int, buffer, size_t, off_t); \
        if (fd_below(fd)) { int e = gate; if (e) { errno = e; return -1; } n = shorter(n, what); } \
        return real(fd, b, n, at); \
    }
DATA(read, READS, reading(), void *)
DATA(write, CHANGES, change(0), const void *)
PDATA(pread, READS, reading(), void *)
PDATA(pread64, READS, reading(), void *)
PDATA(pwrite, CHANGES, change(0), const void *)
PDATA(pwrite64, CHANGES, change(0), const void *)
ssize_t writev(int fd, const struct iovec *v, int n) {
    REAL(ssize_t, "writev", int, const struct iovec *, int);
    CHANGE(fd_below(fd), 0);
    return real(fd, v, n);
}

#define OPENAT(name) \
    int name(int dir, const char *path, int flags, ...) { \
        REAL(int, #name, int, const char *, int, ...); \
        va_list rest; va_start(rest, flags); mode_t mode = va_arg(rest, mode_t); va_end(rest); \
        CHANGE((flags & (O_ACCMODE | O_CREAT | O_TRUNC)) && name_below(dir, path), 1); \
        return real(dir, path, flags, mode); \
    }
#define OPEN(name) \
    int name(const char *path, int flags, ...) { \
        REAL(int, #name, const char *, int, ...); \
        va_list rest; va_start(rest, flags); mode_t mode = va_arg(rest, mode_t); va_end(rest); \
        CHANGE((flags & (O_ACCMODE | O_CREAT | O_TRUNC)) && name_below(AT_FDCWD, path), 1); \
        return real(path, flags, mode); \
    }
OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)
int creat(const char *path, mode_t mode) { return open(path, O_CREAT | O_WRONLY | O_TRUNC, mode); }
int creat64(const char *path, mode_t mode) { return creat(path, mode); }
int rename(const char *a, const char *b) {
    REAL(int, "rename", const char *, const char *);
    CHANGE(name_below(AT_FDCWD, b), 1);
    return real(a, b);
}
int renameat(int d, const char *a, int e, const char *b) {
    REAL(int, "renameat", int, const char *, int, const char *);
    CHANGE(name_below(e, b), 1);
    return real(d, a, e, b);
}
int mkdir(const char *path, mode_t mode) {
    REAL(int, "mkdir", const char *, mode_t);
    CHANGE(name_below(AT_FDCWD, path), 1);
    return real(path, mode);
}
#define ON_FD(name, is_name, declared, ...) \
    int name declared { REAL(int, #name, __VA_ARGS__);
ON_FD(ftruncate, 0, (int fd, off_t n), int, off_t) CHANGE(fd_below(fd), 0); return real(fd, n); }
ON_FD(ftruncate64, 0, (int fd, off_t n), int, off_t) CHANGE(fd_below(fd), 0); return real(fd, n); }
ON_FD(fallocate, 0, (int fd, int m, off_t a, off_t n), int, int, off_t, off_t)
    CHANGE(fd_below(fd), 0); return real(fd, m, a, n); }
ON_FD(fsync, 0, (int fd), int) CHANGE(fd_below(fd), 0); return real(fd); }
ON_FD(fdatasync, 0, (int fd), int) CHANGE(fd_below(fd), 0); return real(fd); }
ssize_t copy_file_range(int a, off_t *x, int b, off_t *y, size_t n, unsigned flags) {
    REAL(ssize_t, "copy_file_range", int, off_t *, int, off_t *, size_t, unsigned);
    CHANGE(fd_below(b), 0);
    return real(a, x, b, y, n, flags);
}
ssize_t sendfile(int out, int in, off_t *at, size_t n) {
    REAL(ssize_t, "sendfile", int, int, off_t *, size_t);
    CHANGE(fd_below(out), 0);
    return real(out, in, at, n);
}

/* From reading nth on, the wall clock is a day ahead if nth is odd, a day behind if it is even. */
static long jump(void) {
    if (!counts) return 0;
    long now = atomic_fetch_add(&counts[CLOCKS], 1) + 1;
    return now >= nth && is("clock") ? (nth % 2 ? 86400 : -86400) : 0;
}
int clock_gettime(clockid_t clock, struct timespec *t) {
    REAL(int, "clock_gettime", clockid_t, struct timespec *);
    int result = real(clock, t);
    if (clock == CLOCK_REALTIME && !result) t->tv_sec += jump();
    return result;
}
int gettimeofday(struct timeval *restrict t, void *restrict zone) {
    REAL(int, "gettimeofday", struct timeval *, void *);
    int result = real(t, zone);
    if (!result) t->tv_sec += jump();
    return result;
}
time_t time(time_t *out) {
    REAL(time_t, "time", time_t *);
    time_t now = real(NULL) + jump();
    if (out) *out = now;
    return now;
}
