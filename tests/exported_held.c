/* A robot in MuJoCo that a hand holds, for test_export.py: ./held MODEL stand|turn SECONDS HEIGHT.
 * stand: it steps in place so high above its stance, is put down and then walks; turn: it is told to
 * walk a curve and is held where it is. The exit code is 1 if it falls in the five seconds after. */
#include <mujoco/mujoco.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "controller.h"

static const char *joint_names[CONTROLLER_JOINTS] = CONTROLLER_JOINT_NAMES;
static struct controller controller;

int main(int count, char **words) {
    mjModel *m = count == 5 ? mj_loadXML(words[1], NULL, NULL, 0) : NULL;
    if (!m) return fprintf(stderr, "expected MODEL.xml stand|turn SECONDS HEIGHT\n"), 2;
    mjData *d = mj_makeData(m);
    struct controller_estimate e;
    struct controller_output out;
    int stands = !strcmp(words[2], "stand"), others = 0;
    int from = stands ? 0 : CONTROLLER_TICK_0, to = from + (int)(1000 * atof(words[3]));
    mj_resetDataKeyframe(m, d, 0);
    double height = d->qpos[2] + atof(words[4]);
    controller_init(&controller);
    for (int ms = 0; ms < to + 8000; ++ms) {
        if (ms >= from && ms < to) { /* the hand */
            const double level[7] = { 0, 0, stands ? height : d->qpos[2], 1, 0, 0, 0 };
            const double still[6] = { 0, 0, stands ? 0 : d->qvel[2], 0, 0, 0 };
            mju_copy(d->qpos, level, 7);
            mju_copy(d->qvel, still, 6);
        }
        controller_from_imu(d->qpos + 3, d->qvel + 3, d->qpos, d->qvel, &e);
        for (int i = 0; i < CONTROLLER_JOINTS; ++i) {
            int joint = mj_name2id(m, mjOBJ_JOINT, joint_names[i]);
            e.joints[i] = d->qpos[m->jnt_qposadr[joint]];
            e.joint_rates[i] = d->qvel[m->jnt_dofadr[joint]];
        }
        if (ms == (stands ? to + 3000 : CONTROLLER_TICK_0))
            controller_drive(&controller, 0.3, 0.0, 0.5);
        others += controller_step_at(&controller, ms, &e, NULL, NULL, &out) != CONTROLLER_SOLVED;
        mju_copy(d->ctrl, out.torque, CONTROLLER_JOINTS);
        mj_step(m, d);
    }
    printf("height %.2f m, %d calls with another status than 0\n", e.position[2], others);
    mj_deleteData(d);
    mj_deleteModel(m);
    return others > 0 || e.position[2] < 0.7 * CONTROLLER_STANDING_HEIGHT;
}
