/* A wall clock that is off by as many seconds as the file WRONG_CLOCK_FILE says, for LD_PRELOAD. Monotonic clocks are
   right, as after a jump of a real clock. libfaketime 0.9.10 cannot do this: clock_nanosleep then fails with EINVAL. */
#define _GNU_SOURCE
#include <stdlib.h>
#include <stdio.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static long offset_s(long now_s) {
    static __thread long read_at_s = -1, offset = 0;
    if (now_s != read_at_s) { /* once a second */
        read_at_s = now_s;
        const char *name = getenv("WRONG_CLOCK_FILE");
        FILE *file = name ? fopen(name, "r") : NULL;
        if (file) {
            long found;
            if (fscanf(file, "%ld", &found) == 1) offset = found;
            fclose(file);
        }
    }
    return offset;
}

int clock_gettime(clockid_t clock, struct timespec *at) {
    int status = (int)syscall(SYS_clock_gettime, clock, at);
    if (status == 0 && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) at->tv_sec += offset_s(at->tv_sec);
    return status;
}

int gettimeofday(struct timeval *restrict at, void *restrict zone) {
    (void)zone;
    struct timespec exact;
    if (clock_gettime(CLOCK_REALTIME, &exact) != 0) return -1;
    at->tv_sec = exact.tv_sec;
    at->tv_usec = exact.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *at) {
    struct timespec exact;
    clock_gettime(CLOCK_REALTIME, &exact);
    if (at) *at = exact.tv_sec;
    return exact.tv_sec;
}
