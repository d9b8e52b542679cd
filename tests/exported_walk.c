/* An exported controller along recorded inputs, for test_export.py: ./walk ESTIMATES COMMAND ANCHORS */
#include <stdio.h>

#include "controller.h"

static struct controller c;

int main(int count, char **files) {
    struct controller_estimate estimate;
    struct controller_command command;
    struct controller_anchor anchor;
    struct controller_output output;
    FILE *in[3];
    double sum = 0.0;
    for (int i = 0; i < 3 && i + 1 < count; ++i) in[i] = fopen(files[i + 1], "rb");
    if (!fread(&command, sizeof command, 1, in[1])) return 1;
    for (controller_init(&c); fread(&estimate, sizeof estimate, 1, in[0]) == 1;) {
        if (!fread(&anchor, sizeof anchor, 1, in[2])) return 1;
        controller_step(&c, &estimate, &command, &anchor, &output);
        for (int i = 0; i < CONTROLLER_JOINTS; ++i) sum += output.torque[i];
    }
    return printf("%.17g\n", sum) < 0;
}
