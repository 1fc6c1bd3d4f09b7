/* MuJoCo's HalfCheetah under a policy, corrected without Python: build.py makes all that it needs.

       ./half_cheetah half_cheetah.xml alone|afm [steps]

   Its fourth motor is reversed after a fifth of the steps. It prints how far it came by then, and in
   all. What is to be written for another robot is expect(): how a copy of it moves. */
#include <mujoco/mujoco.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core.h"
#include "measure.h"
#include "policy.h"

enum { A = 6, N = 9, D = 2 * N, SKIP = 5, REVERSED = 3 };
static const double STEP = 1e-4; /* of derivatives, shares of the largest command */

typedef struct {
    double position[N], velocity[N], warm[N];
} State;

static State state_of(const mjData *data) {
    State state;
    memcpy(state.position, data->qpos, sizeof state.position);
    memcpy(state.velocity, data->qvel, sizeof state.velocity);
    memcpy(state.warm, data->qacc_warmstart, sizeof state.warm);
    return state;
}

static void simulate(const mjModel *robot, mjData *data, const double *command) {
    for (int k = 0; k < A; ++k) data->ctrl[k] = command[k];
    for (int k = 0; k < SKIP; ++k) mj_step(robot, data);
}

/* The model: where a command leads to from a state. Commands beyond their range are no mistake. */
static State expect(const mjModel *model, mjData *copy, const State *from, const double *command) {
    memcpy(copy->qpos, from->position, sizeof from->position);
    memcpy(copy->qvel, from->velocity, sizeof from->velocity);
    memcpy(copy->qacc_warmstart, from->warm, sizeof from->warm);
    simulate(model, copy, command);
    return state_of(copy);
}

/* By how much a state is beyond another one, in standard deviations of the model. */
static void difference(const State *state, const State *other, double scale, double *rows, int by) {
    for (int k = 0; k < N; ++k) {
        rows[k * by] = (state->position[k] - other->position[k]) / 0.01 / scale;
        rows[(N + k) * by] = (state->velocity[k] - other->velocity[k]) / 0.1 / scale;
    }
}

static void *buffer(size_t size) {
    void *room = aligned_alloc(64, (size + 63) / 64 * 64);
    if (room == NULL) exit(2);
    return room;
}

/* The command that the model needs to explain a transition, as the core takes it. */
static void measure(const mjModel *model, mjData *copy, const State *before, const State *after,
                    const double *sent, const float *memory, float *measured, void *workspace) {
    static double search[2][afm_measure_search];
    double error[D], jacobian[D * A] = {0}, asked[A], wants = 1;
    memset(search, 0, sizeof search);
    State there = expect(model, copy, before, sent);
    for (int now = 0; wants != 0; now = 1 - now) {
        difference(after, &there, 1, error, 1);
        afm_measure(1, memory, search[now], sent, error, jacobian, search[1 - now], asked, &wants,
                    measured, workspace);
        if (wants != 0) there = expect(model, copy, before, asked);
        for (int k = 0; k < A && wants == 2; ++k) {
            double moved[A];
            memcpy(moved, asked, sizeof moved);
            moved[k] += STEP;
            const State beside = expect(model, copy, before, moved);
            difference(&beside, &there, STEP, jacobian + k, A);
        }
    }
}

int main(int count, char **words) {
    if (count < 3) return fprintf(stderr, "%s MODEL.xml alone|afm [steps]\n", words[0]), 2;
    const int corrected = strcmp(words[2], "afm") == 0, steps = count > 3 ? atoi(words[3]) : 1000;
    char reason[300];
    mjModel *robot = mj_loadXML(words[1], NULL, reason, sizeof reason);
    if (robot == NULL) return fprintf(stderr, "%s\n", reason), 2;
    mjModel *model = mj_copyModel(NULL, robot);
    model->opt.disableflags |= mjDSBL_CLAMPCTRL;
    mjData *data = mj_makeData(robot), *copy = mj_makeData(model);
    void *core = buffer(afm_core_workspace), *rounds = buffer(afm_measure_workspace);
    void *acting = buffer(policy_workspace);
    static float memory[2][afm_core_memory];
    /* No pair was seen yet: it does not count. */
    float measured[3 * A + 2] = {0}, plan[A], box[2 * A], command[A];
    float predicted[A], spread[A], bounds[2 * A];
    double sent[A], effect[A];
    bool corrects;
    for (int k = 0; k < A; ++k) {
        measured[2 * A + k] = 1;
        memory[0][afm_core_memory - A + k] = 0.05f;
        box[k] = -1, box[A + k] = 1;
    }
    for (int step = 0; step < steps; ++step) {
        /* The policy plans. */
        float seen[2 * N - 1];
        for (int k = 1; k < N; ++k) seen[k - 1] = (float)data->qpos[k];
        for (int k = 0; k < N; ++k) seen[N - 1 + k] = (float)data->qvel[k];
        policy(1, seen, plan, acting);
        memcpy(command, plan, sizeof command);
        /* The core corrects. */
        if (corrected) {
            const float *now = memory[step % 2];
            float *next = memory[1 - step % 2];
            afm_core(1, now, measured, plan, box, box, next, command, predicted, spread, bounds,
                     &corrects, core);
        }
        /* The robot moves, and the model says what the command was worth. */
        for (int k = 0; k < A; ++k) {
            sent[k] = command[k];
            effect[k] = k == REVERSED && step >= steps / 5 ? -sent[k] : sent[k];
        }
        const State before = state_of(data);
        simulate(robot, data, effect);
        const State after = state_of(data);
        if (corrected)
            measure(model, copy, &before, &after, sent, memory[1 - step % 2], measured, rounds);
        if (step + 1 == steps / 5 || step + 1 == steps) printf("%.4f\n", data->qpos[0]);
    }
    return 0;
}
