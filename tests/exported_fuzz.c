/* Random calls of an exported controller, compiled beside its controller.c, for test_exported.py:
 * ./fuzz CALLS SEED ESTIMATES, a file of estimates of a walk, which it disturbs: a little, as pushes
 * do, up to the limits of controller.h, beyond them. It prints calls by status, plans by status, the
 * largest torque by its limit, and how far a wrench of status 0 to 2 or 5 was outside its rows by the
 * largest force; the exit code is 1 if a call broke a rule. */
#include "controller.c"

#include <stdio.h>

#define RULE(what) do { if (!(what)) broken += printf("call %ld breaks " #what "\n", calls) > 0; } while (0)

static Controller c, before;
static struct controller_memory memory, memory_before;
static Targets handed; /* to controller_hold */
static Output out;
static Estimate walk[4096];
static long calls, broken, by_call[9], by_plan[9], refused, accepted;
static double highest, outermost;
static uint64_t state;

static double uniform(double low, double high) {
    state ^= state << 13, state ^= state >> 7, state ^= state << 17;
    return low + (high - low) * (double)(state >> 11) / 9007199254740992.0;
}
static int one_in(int n) { return uniform(0, n) < 1.0; }

static double absurd(void) {
    const double odd[] = { NAN, HUGE_VAL, -HUGE_VAL, 1e308, -1e308, 5e-324, 1e20, -0.0 };
    return odd[(int)uniform(0, 8)];
}

/* A number in its bounds, mostly of any order of magnitude. */
static double inside(double low, double high) {
    if (high > 1e6) high = 1e6;
    if (low > 0.0 && !one_in(3)) return clip(exp(uniform(log(low), log(high))), low, high);
    return one_in(8) ? (one_in(2) ? low : high) : uniform(low, high);
}

static Estimate estimate(int level, int place) {
    static const double sizes[4][6] = { { 0.01, 0.01, 0.1, 0.1, 0.01, 0.3 },
                                        { 0.4, 0.1, 4, 2, 0.3, 10 },
                                        { 10, 1e5, 1e3, 50, 10, 1e3 },
                                        { 3, 1, 20, 10, 2, 50 } };
    Estimate e = walk[place];
    double *parts[6] = { e.euler, e.position, e.ang_velocity, e.velocity, e.joints, e.joint_rates };
    FOR(p, 6) FOR(i, p < 4 ? 3 : JOINTS) if (level != 2 || one_in(6))
        parts[p][i] += uniform(-1, 1) * uniform(0, 1) * sizes[level][p];
    if (one_in(20)) e.euler[2] += 2.0 * PI * floor(uniform(-1e3, 1e3));
    if (one_in(50)) parts[(int)uniform(0, 6)][(int)uniform(0, 3)] = absurd();
    return e;
}

static void command(Command *k, Anchor *a, int level) {
    const double speed = !level ? 0.6 : one_in(20) ? 12.0 : 10.0;
    memset(k, 0, sizeof *k);
    k->pieces = one_in(40) ? (int)uniform(-10, 40) : 1 + (int)uniform(0, CONTROLLER_PIECES);
    FOR(i, CONTROLLER_PIECES) {
        k->duration[i] = one_in(10) ? 0.0 : exp(uniform(-5, 13.8));
        FOR(x, 2) k->velocity[i][x] = uniform(-speed, speed);
        k->yaw_rate[i] = uniform(-speed, speed);
    }
    FOR(x, 3) a->position[x] = walk[0].position[x] + (level ? uniform(-1, 1) * exp(uniform(-3, 12)) : 0.0);
    a->yaw = uniform(-1, 1) * (one_in(4) ? 1e6 : 4.0);
    a->tick = one_in(30) ? (one_in(2) ? INT64_MIN : INT64_MAX) : (int64_t)uniform(-1000, 100);
    if (one_in(50)) k->velocity[0][0] = absurd();
    if (one_in(50)) k->yaw_rate[0] = absurd();
    if (one_in(50)) a->position[2] = absurd();
    if (one_in(50)) a->yaw = absurd();
}

static void retune(void) {
    enum { COUNT = sizeof(Tunables) / sizeof(double) };
    double x[COUNT], low[COUNT], high[COUNT];
    const int near = one_in(3);
    Tunables t, kept = c.next;
    memcpy(x, &controller_exported, sizeof x);
    memcpy(low, &controller_lower, sizeof low);
    memcpy(high, &controller_upper, sizeof high);
    FOR(i, COUNT) if (!near || one_in(4)) x[i] = inside(low[i], high[i]);
    if (one_in(10)) x[(int)uniform(0, COUNT)] = absurd();
    memcpy(&t, x, sizeof t);
    if (controller_set_tunables(&c, &t)) {
        ++refused;
        RULE(memcmp(&c.next, &kept, sizeof kept) == 0);
    } else ++accepted;
}

/* Whether a plan is within the rows of its constraints, and its swing feet are free. */
static void inspect(const Targets *plan) {
    static Qp rows;
    ++by_plan[plan->status];
    RULE(plan->status != CONTROLLER_INFEASIBLE && plan->status != CONTROLLER_UNBOUNDED);
    RULE(within(c.missing, 6, 10.0 * controller_upper.integral_limit) && c.lost >= 0.0 && c.lost <= 1.0);
    FOR(f, FEET) {
        double wrench[6], Rz[3][3], mu = (1.0 - c.lost) * plan->tunables.friction;
        memcpy(wrench, plan->force[f], sizeof plan->force[f]);
        turn(-plan->liftoff.yaw[f], plan->moment[f], wrench + 3);
        wrench[5] = plan->moment[f][2];
        RULE(within(wrench, 6, 1e4 * MAX_FORCE));
        if (!plan->contact[f]) RULE(largest(wrench, 6) == 0.0);
        if (!plan->contact[f] || plan->status == CONTROLLER_BAD_DATA) continue;
        rotation_z(plan->liftoff.yaw[f], Rz);
        constrain(&rows, 0, mu, Rz);
        FOR(r, SIDES) {
            double sum = -rows.bound[r];
            FOR(i, INPUTS) sum += rows.A[r][i] * wrench[COMPONENT[i]];
            outermost = fmax(outermost, sum / MAX_FORCE);
            RULE(sum <= 1e-6 * MAX_FORCE);
        }
    }
}

static void one_call(int kind, int64_t *ms, const Estimate *e, const Command *k, const Anchor *a) {
    const int look = one_in(16);
    int64_t planned = c.set == SET ? c.targets.millisecond : -1, started = c.started;
    int status = CONTROLLER_SOLVED;
    if (look) before = c, memory_before = memory;
    *ms += one_in(200) ? (int64_t)uniform(-50, 200) : one_in(20) ? (int64_t)uniform(0, 30) : 1;
    if (kind == 0) status = controller_step(&c, e, k, a, &out);
    if (kind == 1) status = controller_step_at(&c, *ms, e, k, a, &out);
    if (kind == 2) {
        if (one_in(15)) status = controller_plan(&c, *ms, e, k, a);
        if (look && status == CONTROLLER_BAD_INPUT) RULE(memcmp(&c, &before, sizeof c) == 0);
        if (one_in(2)) handed = c.targets;
        status = controller_hold(&memory, *ms, &handed, e, &out);
        if (look && status == CONTROLLER_BAD_INPUT) RULE(memcmp(&memory, &memory_before, sizeof memory) == 0);
    } else if (look && status == CONTROLLER_BAD_INPUT) RULE(memcmp(&c, &before, sizeof c) == 0);
    ++calls, ++by_call[status];
    RULE(status == out.status);
    FOR(j, JOINTS) {
        RULE(fabs(out.torque[j]) <= TORQUE_LIMIT[j]);
        highest = fmax(highest, fabs(out.torque[j]) / TORQUE_LIMIT[j]);
    }
    if (c.set == SET && c.started && (!started || c.targets.millisecond != planned)) inspect(&c.targets);
}

int main(int count, char **words) {
    FILE *file = count == 4 ? fopen(words[3], "rb") : NULL;
    int rows = file ? (int)fread(walk, sizeof walk[0], 4096, file) : 0;
    long wanted = rows ? atol(words[1]) : 0;
    if (!wanted) return fprintf(stderr, "expected CALLS SEED ESTIMATES\n"), 2;
    state = 88172645463325252u + (uint64_t)atol(words[2]);
    while (calls < wanted) {
        const int kind = (int)uniform(0, 3), level = (int)uniform(0, 4), steady = one_in(2);
        int64_t ms = one_in(9) ? (int64_t)uniform(-10, 1e12) : 0;
        int place = (int)uniform(0, rows);
        Command k;
        Anchor a;
        controller_init(&c);
        memset(&memory, 0, sizeof memory), memset(&handed, 0, sizeof handed), memset(&out, 0, sizeof out);
        command(&k, &a, level);
        if (!one_in(6)) controller_set_max_changes(&c, (int)uniform(-2, one_in(6) ? CONTROLLER_MAX_CHANGES : 20));
        FOR(i, (int)uniform(20, 400)) {
            Estimate e = estimate(steady && !one_in(30) ? 0 : level, place = (place + 1) % rows);
            if (one_in(one_in(2) ? 20 : 200)) retune();
            if (one_in(50)) command(&k, &a, level);
            if (one_in(50)) controller_drive(&c, uniform(-1, 11), one_in(9) ? absurd() : 0.1, uniform(-2, 2));
            if (out.status == CONTROLLER_UNSAFE && one_in(5)) {
                controller_reset(&c);
                memset(&memory, 0, sizeof memory);
            }
            one_call(kind, &ms, &e, one_in(2) && steady ? NULL : &k, steady && one_in(40) ? NULL : &a);
        }
    }
    printf("calls by status");
    FOR(i, 9) printf(" %ld", by_call[i]);
    printf("\nplans by status");
    FOR(i, 9) printf(" %ld", by_plan[i]);
    printf("\ntunables refused %ld accepted %ld\nhighest torque %.17g outermost wrench %.3g\n", refused, accepted, highest, outermost);
    return broken > 0;
}
