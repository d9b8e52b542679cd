/* Walk a robot in MuJoCo with the controller that `hector export` wrote. FOLDER has controller.c;
 * MuJoCo's library is the one of the Python package:
 *
 *     M=$(python -c "import mujoco; print(mujoco.__path__[0])")
 *     cc -O2 -IFOLDER -I$M/include walk.c FOLDER/controller.c $M/libmujoco.so.* -Wl,-rpath,$M -lm -o walk
 *     ./walk assets/hector.xml 4
 *
 * The model has its standing pose as its first keyframe, a time step of 1 ms and motors in the order
 * of the joints.
 */
#include <mujoco/mujoco.h>
#include <stdio.h>
#include <stdlib.h>

#include "controller.h"

static const char *joint_names[CONTROLLER_JOINTS] = CONTROLLER_JOINT_NAMES;
static struct controller controller;

/* On a robot: the state estimate. */
static void measure(const mjModel *m, const mjData *d, struct controller_estimate *e) {
    controller_from_imu(d->qpos + 3, d->qvel + 3, d->qpos, d->qvel, e);
    for (int i = 0; i < CONTROLLER_JOINTS; ++i) {
        int joint = mj_name2id(m, mjOBJ_JOINT, joint_names[i]);
        e->joints[i] = d->qpos[m->jnt_qposadr[joint]];
        e->joint_rates[i] = d->qvel[m->jnt_dofadr[joint]];
    }
}

int main(int count, char **words) {
    char error[1000] = "expected MODEL.xml SECONDS";
    mjModel *m = count == 3 ? mj_loadXML(words[1], NULL, error, sizeof error) : NULL;
    if (!m) return fprintf(stderr, "%s\n", error), 2;
    mjData *d = mj_makeData(m);
    struct controller_estimate estimate;
    struct controller_output output;
    int unsolved = 0;
    mj_resetDataKeyframe(m, d, 0);
    controller_init(&controller);
    for (int ms = 0; ms < CONTROLLER_TICK_0 + (int)(1000 * atof(words[2])); ++ms) {
        measure(m, d, &estimate);
        if (ms == CONTROLLER_TICK_0) /* before, it steps in place */
            controller_drive(&controller, 0.3, 0.0, 0.5);
        controller_step(&controller, &estimate, NULL, NULL, &output);
        if (output.status != CONTROLLER_SOLVED && output.status != CONTROLLER_NOT_UNIQUE)
            ++unsolved; /* on a robot: see docs/export.md */
        mju_copy(d->ctrl, output.torque, CONTROLLER_JOINTS); /* on a robot: to its motors */
        mj_step(m, d);
    }
    measure(m, d, &estimate);
    printf("x %.3f y %.3f z %.3f yaw %.3f; %d calls without a solution\n", estimate.position[0],
           estimate.position[1], estimate.position[2], estimate.euler[2], unsolved);
    mj_deleteData(d);
    mj_deleteModel(m);
    return unsolved > 0;
}
