/* CPU times of an exported controller, for test_exported.py: ./time ESTIMATES, a file of estimates of
 * a walk. It prints medians and largest times [ms] of a plan and a hold along the walk, and of both
 * while a robot that stands is pushed with 2 m/s. Each hold is made five times: the shortest counts,
 * as the computer has other programs. */
#define _POSIX_C_SOURCE 200809L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "controller.h"

enum { ROWS = 3000, AGAIN = 5 };
static struct controller c;
static struct controller_memory memory;
static struct controller_estimate walk[ROWS];
static double plans[ROWS], holds[ROWS];

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return 1e3 * (double)t.tv_sec + 1e-6 * (double)t.tv_nsec;
}

static double plan(int ms, const struct controller_estimate *e) {
    double begin = now();
    controller_plan(&c, ms, e, NULL, NULL);
    return now() - begin;
}

static double hold(int ms, const struct controller_estimate *e) {
    struct controller_output out;
    double shortest = 1e9;
    for (int i = 0; i < AGAIN; ++i) {
        double begin = now();
        controller_hold(&memory, ms, &c.targets, e, &out);
        shortest = fmin(shortest, now() - begin);
    }
    return shortest;
}

static int order(const void *a, const void *b) {
    return (*(const double *)a > *(const double *)b) - (*(const double *)a < *(const double *)b);
}

static void say(const char *what, double *times, int count) {
    qsort(times, (size_t)count, sizeof *times, order);
    printf("%s %.5f %.5f\n", what, times[count / 2], times[count - 1]);
}

int main(int count, char **words) {
    FILE *file = count == 2 ? fopen(words[1], "rb") : NULL;
    const int rows = file ? (int)fread(walk, sizeof walk[0], ROWS, file) : 0, period = CONTROLLER_PERIOD;
    int made = 0;
    if (!rows) return fprintf(stderr, "expected ESTIMATES\n"), 2;
    controller_init(&c);
    for (int ms = 0; ms < rows; ++ms) {
        if (ms == CONTROLLER_TICK_0) controller_drive(&c, 0.3, 0.0, 0.5);
        if (ms % period == 0) plans[made++] = plan(ms, &walk[ms]);
        holds[ms] = hold(ms, &walk[ms]);
    }
    say("walk: plan", plans, made);
    say("walk: hold", holds, rows);
    for (int k = 0; k < ROWS / period; ++k) {
        struct controller_estimate e = walk[0];
        const double angle = 0.1 * k;
        controller_reset(&c);
        memset(&memory, 0, sizeof memory);
        e.velocity[0] = 2.0 * cos(angle), e.velocity[1] = 2.0 * sin(angle);
        plans[k] = plan(0, &e);
        for (int ms = 0; ms < period; ++ms) {
            for (int i = 0; i < 2; ++i) e.position[i] += 1e-3 * e.velocity[i];
            holds[k * period + ms] = hold(ms, &e);
        }
    }
    say("push: plan", plans, ROWS / period);
    say("push: hold", holds, ROWS);
    return 0;
}
