/* Faults of a file system, for tests: counts the calls that change files under one folder, and the opens and reads of
   files under another, and lets the n-th of them fail, or the process die at it. Preloaded (LD_PRELOAD) and armed in
   the process itself by fault_arm. Calls that libc makes within itself (stdio) and writes through memory maps are not
   seen; fopen for writing is. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum action { COUNT, KILL, TEAR, FULL, IO_ERROR, SHORT, SHORT_FULL, DENY, VANISH, CUT, READ_ERROR, HALT };

static char write_root[PATH_MAX], read_root[PATH_MAX];
static atomic_long changes, inputs;
static long at;
static int action = -1, trace = -1;
static atomic_int full;

void fault_arm(const char *writes, const char *reads, long n, int what, const char *trace_path) {
    snprintf(write_root, sizeof write_root, "%s", writes);
    snprintf(read_root, sizeof read_root, "%s", reads);
    atomic_store(&changes, 0);
    atomic_store(&inputs, 0);
    atomic_store(&full, 0);
    at = n;
    trace = trace_path[0] ? (int)syscall(SYS_openat, AT_FDCWD, trace_path, O_WRONLY | O_CREAT | O_APPEND, 0600) : -1;
    action = what;
}

static int under(const char *root, const char *path) {
    size_t n = strlen(root);
    return n && !strncmp(path, root, n) && (path[n] == '/' || path[n] == 0);
}

/* The absolute name of a path relative to an open folder; 0 if there is none. */
static int full_name(int folder, const char *path, char *name) {
    if (!path) return 0;
    if (path[0] == '/') return snprintf(name, PATH_MAX, "%s", path) < PATH_MAX;
    char link[64], base[PATH_MAX];
    if (folder == AT_FDCWD) {
        if (syscall(SYS_getcwd, base, sizeof base) < 0) return 0;
    } else {
        snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
        long n = syscall(SYS_readlinkat, AT_FDCWD, link, base, sizeof base - 1);
        if (n < 0) return 0;
        base[n] = 0;
    }
    return snprintf(name, PATH_MAX, "%s%s%s", base, path[0] ? "/" : "", path) < PATH_MAX;
}

static int of_descriptor(int fd, char *name) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    long n = syscall(SYS_readlinkat, AT_FDCWD, link, name, PATH_MAX - 1);
    if (n < 0) return 0;
    name[n] = 0;
    return 1;
}

static void note(long n, const char *call, const char *name, long size) {
    char line[PATH_MAX + 100];
    if (trace < 0) return;
    int length = snprintf(line, sizeof line, "%ld\t%s\t%ld\t%s\n", n, call, size, name);
    syscall(SYS_write, trace, line, (size_t)length);
}

static void die(void) {
    syscall(SYS_kill, syscall(SYS_getpid), SIGKILL);
    for (;;) syscall(SYS_pause);
}

/* What becomes of a call that changes files: 0 = it goes on; 1 = it fails with errno; 2 = half of it is done. `grows`:
   a full disk refuses it. */
static int change(const char *call, const char *name, long size, int grows) {
    if (action < 0 || !under(write_root, name)) return 0;
    long n = atomic_fetch_add(&changes, 1) + 1;
    note(n, call, name, size);
    if (grows && atomic_load(&full)) {
        errno = ENOSPC;
        return 1;
    }
    if (n != at) return 0;
    switch (action) {
    case KILL: die(); break;
    case TEAR: if (size < 2) die(); return 2;
    case FULL:
        atomic_store(&full, 1);
        if (!grows) return 0;
        errno = ENOSPC;
        return 1;
    case SHORT_FULL:
        atomic_store(&full, 1);
        if (size >= 2) return 2;
        if (!grows) return 0;
        errno = ENOSPC;
        return 1;
    case SHORT: return size >= 2 ? 2 : 0;
    case IO_ERROR: errno = EIO; return 1;
    case HALT: syscall(SYS_kill, syscall(SYS_getpid), SIGSTOP); return 0;
    }
    return 0;
}

/* The same for inputs that are opened. */
static int opened(const char *name) {
    struct stat about;
    if (action < 0 || !under(read_root, name) || syscall(SYS_newfstatat, AT_FDCWD, name, &about, 0) < 0 || !S_ISREG(about.st_mode)) return 0;
    long n = atomic_fetch_add(&inputs, 1) + 1;
    note(n, "input", name, (long)about.st_size);
    if (n != at) return 0;
    switch (action) {
    case DENY: errno = EACCES; return 1;
    case VANISH:
        syscall(SYS_unlinkat, AT_FDCWD, name, 0);
        return 0;
    case CUT: syscall(SYS_truncate, name, about.st_size / 2); return 0;
    case READ_ERROR: return 3;
    }
    return 0;
}

#define REAL(name) __typeof__(&name) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

static int failing[64];
static atomic_int failing_count;

static int open_at(int folder, const char *path, int flags, mode_t mode) {
    char name[PATH_MAX];
    int known = action >= 0 && full_name(folder, path, name), bad = 0;
    if (known && (flags & (O_CREAT | O_TRUNC))) {
        if (change("open", name, 0, (flags & O_CREAT) != 0)) return -1;
    } else if (known && (flags & O_ACCMODE) == O_RDONLY && !(flags & O_DIRECTORY)) {
        bad = opened(name);
        if (bad == 1) return -1;
    }
    int fd = (int)syscall(SYS_openat, folder, path, flags, mode);
    if (bad == 3 && fd >= 0) {
        int i = atomic_fetch_add(&failing_count, 1);
        if (i < 64) failing[i] = fd;
    }
    return fd;
}

static int fails(int fd) {
    for (int i = 0, n = atomic_load(&failing_count); i < n && i < 64; i++)
        if (failing[i] == fd) return 1;
    return 0;
}

#define MODE(flags) mode_t mode = 0; if ((flags) & (O_CREAT | __O_TMPFILE)) { va_list more; va_start(more, flags); mode = va_arg(more, mode_t); va_end(more); }
int open(const char *path, int flags, ...) { MODE(flags) return open_at(AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags) return open_at(AT_FDCWD, path, flags | O_LARGEFILE, mode); }
int openat(int folder, const char *path, int flags, ...) { MODE(flags) return open_at(folder, path, flags, mode); }
int openat64(int folder, const char *path, int flags, ...) { MODE(flags) return open_at(folder, path, flags | O_LARGEFILE, mode); }
int creat(const char *path, mode_t mode) { return open_at(AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, mode); }

static int fopen_fails(const char *path, const char *mode) {
    char name[PATH_MAX];
    if (action < 0 || !full_name(AT_FDCWD, path, name)) return 0;
    if (mode[0] != 'r') return change("fopen", name, 0, 1);
    return opened(name) == 1;
}
FILE *fopen(const char *path, const char *mode) { REAL(fopen); return fopen_fails(path, mode) ? NULL : real(path, mode); }
FILE *fopen64(const char *path, const char *mode) { REAL(fopen64); return fopen_fails(path, mode) ? NULL : real(path, mode); }

/* How many of `size` bytes are written: -1 = none. */
static long allowed(const char *call, int fd, long size, int *tear) {
    char name[PATH_MAX];
    *tear = 0;
    if (action < 0 || !of_descriptor(fd, name)) return size;
    int what = change(call, name, size, 1);
    if (what == 1) return -1;
    *tear = what == 2 && action == TEAR;
    return what == 2 ? size / 2 : size;
}

ssize_t write(int fd, const void *data, size_t size) {
    int tear;
    long n = allowed("write", fd, (long)size, &tear);
    if (n < 0) return -1;
    ssize_t done = syscall(SYS_write, fd, data, (size_t)n);
    if (tear) die();
    return done;
}
static ssize_t pwrite_at(int fd, const void *data, size_t size, off_t where) {
    int tear;
    long n = allowed("pwrite", fd, (long)size, &tear);
    if (n < 0) return -1;
    ssize_t done = syscall(SYS_pwrite64, fd, data, (size_t)n, where);
    if (tear) die();
    return done;
}
ssize_t pwrite(int fd, const void *data, size_t size, off_t where) { return pwrite_at(fd, data, size, where); }
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t where) { return pwrite_at(fd, data, size, where); }
ssize_t writev(int fd, const struct iovec *parts, int count) {
    int tear;
    long size = 0;
    for (int i = 0; i < count; i++) size += (long)parts[i].iov_len;
    long n = allowed("writev", fd, size, &tear);
    if (n < 0) return -1;
    if (n == size) return syscall(SYS_writev, fd, parts, count);
    int i = 0;
    while (i < count && !parts[i].iov_len) i++;
    ssize_t done = syscall(SYS_write, fd, parts[i].iov_base, parts[i].iov_len > (size_t)n ? (size_t)n : parts[i].iov_len);
    if (tear) die();
    return done;
}
ssize_t sendfile(int to, int from, off_t *where, size_t size) {
    int tear;
    struct stat about;
    long whole = fstat(from, &about) == 0 && (long)size > about.st_size ? (long)about.st_size : (long)size;
    long n = allowed("sendfile", to, whole, &tear);
    if (n < 0) return -1;
    ssize_t done = syscall(SYS_sendfile, to, from, where, (size_t)(n == whole ? (long)size : n));
    if (tear) die();
    return done;
}
ssize_t sendfile64(int to, int from, off64_t *where, size_t size) { return sendfile(to, from, where, size); }

#define READS if (action == READ_ERROR && fails(fd)) { errno = EIO; return -1; }
ssize_t read(int fd, void *data, size_t size) { READS return syscall(SYS_read, fd, data, size); }
ssize_t pread(int fd, void *data, size_t size, off_t where) { READS return syscall(SYS_pread64, fd, data, size, where); }
ssize_t pread64(int fd, void *data, size_t size, off64_t where) { READS return syscall(SYS_pread64, fd, data, size, where); }
int close(int fd) {
    for (int i = 0, n = atomic_load(&failing_count); i < n && i < 64; i++)
        if (failing[i] == fd) failing[i] = -1;
    return (int)syscall(SYS_close, fd);
}

#define FD_CALL(call, number, grows, ...) \
    char name[PATH_MAX]; \
    if (action >= 0 && of_descriptor(fd, name) && change(call, name, 0, grows)) return -1; \
    return (int)syscall(number, __VA_ARGS__);
int fsync(int fd) { FD_CALL("fsync", SYS_fsync, 0, fd) }
int fdatasync(int fd) { FD_CALL("fsync", SYS_fdatasync, 0, fd) }
int ftruncate(int fd, off_t size) { FD_CALL("ftruncate", SYS_ftruncate, 1, fd, size) }
int ftruncate64(int fd, off64_t size) { FD_CALL("ftruncate", SYS_ftruncate, 1, fd, size) }
int fchmod(int fd, mode_t mode) { FD_CALL("chmod", SYS_fchmod, 0, fd, mode) }

#define PATH_CALL(call, folder, path, grows, number, ...) \
    char name[PATH_MAX]; \
    if (action >= 0 && full_name(folder, path, name) && change(call, name, 0, grows)) return -1; \
    return (int)syscall(number, __VA_ARGS__);
int mkdir(const char *path, mode_t mode) { PATH_CALL("mkdir", AT_FDCWD, path, 1, SYS_mkdirat, AT_FDCWD, path, mode) }
int mkdirat(int folder, const char *path, mode_t mode) { PATH_CALL("mkdir", folder, path, 1, SYS_mkdirat, folder, path, mode) }
int rmdir(const char *path) { PATH_CALL("rmdir", AT_FDCWD, path, 0, SYS_unlinkat, AT_FDCWD, path, AT_REMOVEDIR) }
int unlink(const char *path) { PATH_CALL("unlink", AT_FDCWD, path, 0, SYS_unlinkat, AT_FDCWD, path, 0) }
int unlinkat(int folder, const char *path, int flags) { PATH_CALL(flags & AT_REMOVEDIR ? "rmdir" : "unlink", folder, path, 0, SYS_unlinkat, folder, path, flags) }
int remove(const char *path) { struct stat about; return lstat(path, &about) == 0 && S_ISDIR(about.st_mode) ? rmdir(path) : unlink(path); }
int chmod(const char *path, mode_t mode) { PATH_CALL("chmod", AT_FDCWD, path, 0, SYS_fchmodat, AT_FDCWD, path, mode) }
int symlink(const char *target, const char *path) { PATH_CALL("symlink", AT_FDCWD, path, 1, SYS_symlinkat, target, AT_FDCWD, path) }
int link(const char *from, const char *path) { PATH_CALL("link", AT_FDCWD, path, 1, SYS_linkat, AT_FDCWD, from, AT_FDCWD, path, 0) }
int rename(const char *from, const char *path) { PATH_CALL("rename", AT_FDCWD, path, 0, SYS_renameat2, AT_FDCWD, from, AT_FDCWD, path, 0) }
int renameat(int a, const char *from, int b, const char *path) { PATH_CALL("rename", b, path, 0, SYS_renameat2, a, from, b, path, 0) }
int renameat2(int a, const char *from, int b, const char *path, unsigned flags) { PATH_CALL("exchange", b, path, 0, SYS_renameat2, a, from, b, path, flags) }

