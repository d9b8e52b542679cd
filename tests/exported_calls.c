/* Calls of an exported controller, for test_export.py: each test returns 0 or the failing line. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "controller.h"

#define CHECK(what) do { if (!(what)) return __LINE__; } while (0)

static struct controller c;
static struct controller_output out;
static const double legs[5] = { 0, 0, 0.785398163397, -1.570796326795, 0.785398163397 };
static const double limit[5] = { 33.5, 33.5, 33.5, 67.0, 33.5 };

static struct controller_estimate standing(void) {
    struct controller_estimate e = { { 0 }, { -0.0107637, 0, 0.4231767 }, { 0 }, { 0 }, { 0 }, { 0 } };
    for (int j = 0; j < CONTROLLER_JOINTS; ++j) e.joints[j] = legs[j % 5];
    return e;
}

static double uniform(double size) { return size * (2.0 * rand() / RAND_MAX - 1.0); }

static int step(int64_t ms, const struct controller_estimate *e) {
    return controller_step_at(&c, ms, e, NULL, NULL, &out);
}

/* The largest amount by which a foot pulls, slides or exceeds 500 N, as the friction is 0.6. */
static double outside(void) {
    double most = 0.0;
    for (int f = 0; f < CONTROLLER_FEET; ++f) {
        const double *F = out.force[f];
        most = fmax(most, fmax(fabs(F[0]) + fabs(F[1]) - 0.6 * F[2], fmax(-F[2], F[2] - 500.0)));
    }
    return most;
}

int test_no_memory(void) {
    struct controller_estimate e = standing();
    memset(&c, 0xFF, sizeof c);
    CHECK(step(0, &e) == CONTROLLER_BAD_INPUT && out.torque[3] == 0.0);
    memset(&c, 0, sizeof c);
    CHECK(step(0, &e) == CONTROLLER_BAD_INPUT && out.torque[3] == 0.0);
    return 0;
}

int test_time(void) {
    struct controller_estimate e = standing();
    controller_init(&c);
    CHECK(step(-1, &e) == CONTROLLER_BAD_INPUT && step(INT64_MIN, &e) == CONTROLLER_BAD_INPUT);
    CHECK(step(INT64_MAX, &e) == CONTROLLER_BAD_INPUT);
    CHECK(step(5000, &e) == CONTROLLER_SOLVED && out.age == 0);
    CHECK(step(5007, &e) == CONTROLLER_SOLVED && out.age == 7);
    CHECK(step(5006, &e) == CONTROLLER_BAD_INPUT); /* the clock goes back */
    CHECK(step(5038, &e) == CONTROLLER_SOLVED && out.age == 8); /* calls were late: time went on */
    CHECK(step(5038 - CONTROLLER_MAX_AGE, &e) == CONTROLLER_BAD_INPUT);
    CHECK(step(5037 - CONTROLLER_MAX_AGE, &e) == CONTROLLER_UNSAFE && out.torque[3] == 0.0);
    CHECK(step(INT64_MIN, &e) == CONTROLLER_UNSAFE && step(5039, &e) == CONTROLLER_SOLVED);
    return 0;
}

int test_blind(void) { /* no good input: the last torques, then damping, also once it is good */
    struct controller_estimate e = standing(), lost = e;
    double last;
    lost.velocity[0] = lost.joint_rates[0] = NAN;
    lost.joint_rates[1] = 2.0;
    controller_init(&c);
    CHECK(step(0, &e) == CONTROLLER_SOLVED);
    last = out.torque[3];
    CHECK(step(CONTROLLER_MAX_AGE, &lost) == CONTROLLER_BAD_INPUT && out.torque[3] == last);
    CHECK(step(CONTROLLER_MAX_AGE + 1, &lost) == CONTROLLER_UNSAFE);
    CHECK(out.torque[0] == 0.0 && out.torque[1] == -2.0 * controller_exported.kd[1]);
    CHECK(step(CONTROLLER_MAX_AGE + 2, &e) == CONTROLLER_UNSAFE && out.torque[3] == 0.0);
    CHECK(step(CONTROLLER_MAX_AGE + 3, &e) == CONTROLLER_UNSAFE);
    controller_reset(&c);
    CHECK(step(CONTROLLER_MAX_AGE + 4, &e) == CONTROLLER_SOLVED && out.torque[3] == last);
    return 0;
}

int test_refused(void) { /* without a clock: refused calls leave no trace, but too many of them do */
    static struct controller one, two;
    struct controller_output other = { { 0 } };
    struct controller_estimate e = standing(), lost = e;
    lost.velocity[0] = NAN;
    out = other;
    controller_init(&one), controller_init(&two);
    for (int ms = 0; ms < 300; ++ms) {
        e.velocity[0] = 0.001 * (ms % 30);
        for (int k = 0; k < ms % 7; ++k) {
            struct controller before = one;
            double last = out.torque[3];
            CHECK(controller_step(&one, &lost, NULL, NULL, &out) == CONTROLLER_BAD_INPUT);
            CHECK(memcmp(&one, &before, sizeof one) == 0 && out.torque[3] == last);
        }
        CHECK(controller_step(&one, &e, NULL, NULL, &out) == CONTROLLER_SOLVED);
        CHECK(controller_step_at(&two, ms, &e, NULL, NULL, &other) == CONTROLLER_SOLVED);
        CHECK(memcmp(&out, &other, sizeof out) == 0 && memcmp(&one, &two, sizeof one) == 0);
    }
    for (int k = 0; k < CONTROLLER_MAX_AGE; ++k)
        CHECK(controller_step(&one, &lost, NULL, NULL, &out) == CONTROLLER_BAD_INPUT);
    CHECK(controller_step(&one, &lost, NULL, NULL, &out) == CONTROLLER_UNSAFE);
    CHECK(controller_step(&one, &e, NULL, NULL, &out) == CONTROLLER_UNSAFE && out.torque[3] == 0.0);
    CHECK(controller_step(&one, &e, NULL, NULL, &out) == CONTROLLER_UNSAFE);
    return 0;
}

int test_unsafe(void) { /* a robot that lies, tilts or has a joint out of its limits */
    for (int k = 0; k < 4; ++k) {
        struct controller_estimate e = standing();
        controller_init(&c);
        CHECK(step(0, &e) == CONTROLLER_SOLVED && out.tilt == 0.0 && out.margin > 0.3);
        CHECK(out.height == e.position[2]);
        e.euler[0] = k == 0 ? CONTROLLER_MAX_TILT + 0.01 : 0.0;
        e.euler[1] = k == 1 ? -CONTROLLER_MAX_TILT - 0.01 : 0.0;
        e.position[2] = k == 2 ? CONTROLLER_MIN_HEIGHT - 0.01 : 0.4;
        e.joints[3] = k == 3 ? 0.3 : legs[3];
        e.joint_rates[0] = 1e3;
        CHECK(step(1, &e) == CONTROLLER_UNSAFE && out.torque[0] == -limit[0]);
        e = standing();
        CHECK(step(2, &e) == CONTROLLER_UNSAFE && out.torque[3] == 0.0);
        controller_reset(&c);
        CHECK(step(3, &e) == CONTROLLER_SOLVED);
    }
    return 0;
}

int test_few_changes(void) { /* a plan that is cut short has a wrench within its constraints */
    int short_ones = 0;
    srand(1);
    controller_init(&c);
    CHECK(controller_set_max_changes(&c, 0) == CONTROLLER_OUT_OF_BOUNDS);
    CHECK(controller_set_max_changes(&c, CONTROLLER_MAX_CHANGES + 1) == CONTROLLER_OUT_OF_BOUNDS);
    CHECK(controller_set_max_changes(&c, 8) == CONTROLLER_SOLVED);
    for (int k = 0; k < 300; ++k) {
        struct controller_estimate e = standing();
        for (int i = 0; i < 3; ++i) e.velocity[i] = uniform(2.0), e.ang_velocity[i] = uniform(3.0);
        controller_reset(&c);
        step(0, &e);
        CHECK(out.status <= CONTROLLER_INACCURATE && out.iterations <= 8);
        CHECK(outside() < 1e-6);
        short_ones += out.status;
    }
    CHECK(short_ones > 100);
    return 0;
}

int test_two_threads(void) { /* plan and hold as two calls do what step does, also a late plan */
    struct controller_memory memory = { 0 };
    struct controller_targets targets = { 0 };
    struct controller_output other, one_more;
    static struct controller one, two;
    struct controller_estimate e = standing();
    controller_init(&one), controller_init(&two);
    CHECK(controller_hold(&memory, 0, &targets, &e, &other) == CONTROLLER_BAD_INPUT);
    for (int64_t ms = 0; ms < 500; ++ms) {
        e.velocity[0] = 0.001 * (double)(ms % 30);
        controller_step_at(&one, ms, &e, NULL, NULL, &out);
        if (ms % CONTROLLER_PERIOD == 0) {
            CHECK(controller_plan(&two, ms, &e, NULL, NULL) == CONTROLLER_SOLVED);
            targets = two.targets;
        }
        CHECK(controller_hold(&memory, ms, &targets, &e, &other) == out.status);
        CHECK(memcmp(&out, &other, sizeof out) == 0);
    }
    for (int64_t ms = 500; ms < 490 + CONTROLLER_MAX_AGE; ++ms)
        CHECK(controller_hold(&memory, ms, &targets, &e, &other) == CONTROLLER_SOLVED);
    CHECK(other.age == CONTROLLER_MAX_AGE - 1);
    two.targets.force[0][2] = two.targets.force[1][2] = 1.7e308; /* no plan of ours */
    two.targets.tunables.gravity_compensation = 1.7e308;
    CHECK(controller_hold(&memory, 489 + CONTROLLER_MAX_AGE, &two.targets, &e, &one_more) == CONTROLLER_BAD_INPUT);
    CHECK(memcmp(one_more.torque, other.torque, sizeof other.torque) == 0);
    CHECK(controller_hold(&memory, 492 + CONTROLLER_MAX_AGE, &targets, &e, &other) == CONTROLLER_UNSAFE);
    return 0;
}

int test_drive(void) { /* the path goes on where the velocity changes */
    struct controller_estimate e = standing();
    controller_init(&c);
    CHECK(controller_drive(&c, 0.0, NAN, 0.0) == CONTROLLER_OUT_OF_BOUNDS);
    CHECK(controller_drive(&c, 0.0, 10.1, 0.0) == CONTROLLER_OUT_OF_BOUNDS && c.drive[1] == 0.0);
    e.euler[2] = 0.5;
    step(0, &e);
    CHECK(c.anchor.position[0] == e.position[0] && c.anchor.yaw == 0.5);
    CHECK(c.anchor.position[2] == CONTROLLER_STANDING_HEIGHT);
    controller_drive(&c, 0.3, 0.0, 0.2);
    step(10, &e), step(20, &e);
    controller_drive(&c, 0.0, 0.1, 0.0);
    e.position[0] += 0.05;
    for (int64_t ms = 30; ms <= 1010; ms += 10) step(ms, &e);
    CHECK(fabs(c.anchor.yaw - 0.504) < 1e-12); /* two ticks of 0.2 rad/s */
    CHECK(fabs(c.anchor.position[0] - standing().position[0] - 0.006 * cos(0.502)) < 1e-6);
    CHECK(c.command.velocity[0][1] == 0.1);
    return 0;
}

int test_imu(void) { /* a pitch of 0.3 rad, a gyro about the trunk's own z */
    static const double com[3] = CONTROLLER_COM;
    const double half = 0.15, q[4] = { cos(half), 0, sin(half), 0 }, gyro[3] = { 0, 0, 2.0 };
    const double origin[3] = { 1, 2, 0.5 }, velocity[3] = { 0.1, 0, 0 }, none[4] = { 0 };
    struct controller_estimate e = standing();
    controller_init(&c);
    CHECK(controller_from_imu(none, gyro, origin, velocity, &e) == CONTROLLER_BAD_INPUT);
    CHECK(step(0, &e) == CONTROLLER_BAD_INPUT);
    CHECK(controller_from_imu(q, gyro, origin, velocity, &e) == CONTROLLER_SOLVED);
    CHECK(fabs(e.euler[0]) + fabs(e.euler[1] - 0.3) + fabs(e.euler[2]) < 1e-12);
    CHECK(fabs(e.ang_velocity[0] - 2.0 * sin(0.3)) + fabs(e.ang_velocity[2] - 2.0 * cos(0.3)) < 1e-12);
    CHECK(fabs(e.position[0] - 1.0 - com[0] * cos(0.3) - com[2] * sin(0.3)) < 1e-12);
    /* R (gyro x com): y of the trunk is y of the world */
    CHECK(fabs(e.velocity[0] - 0.1) < 1e-12 && fabs(e.velocity[1] - 2.0 * com[0]) < 1e-12);
    CHECK(e.joints[3] == legs[3]);
    return 0;
}
