/* The floor of a simulation: classic Runge-Kutta steps of the rig, written by hand, on one core.
   LANES trajectories go side by side in one vector: 1 for a single trajectory; for batches 8 on AVX-512, 4 on AVX2 and 2 on SSE2. Dry
   friction turns its sign over smoothly, as x / sqrt(x^2 + s^2), and the current is held over a step. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#ifndef LANES
#define LANES 1
#endif

#if LANES == 1
typedef double lane;
#define SINE sin
#define COSINE cos
#define ROOT sqrt
#else
typedef double lane __attribute__((vector_size(8 * LANES)));
#if LANES == 8 /* of glibc's libmvec */
#define SINE _ZGVeN8v_sin
#define COSINE _ZGVeN8v_cos
#elif LANES == 4
#define SINE _ZGVdN4v_sin
#define COSINE _ZGVdN4v_cos
#else
#define SINE _ZGVbN2v_sin
#define COSINE _ZGVbN2v_cos
#endif
lane SINE(lane);
lane COSINE(lane);
static inline lane ROOT(lane x) {
  for (int i = 0; i < LANES; i++) x[i] = __builtin_sqrt(x[i]);
  return x;
}
#endif

enum { GROUPS = LANES == 1 ? 1 : 512 / LANES, STEPS = LANES == 1 ? 10000 : 2000, RUNS = 5 };
static const double STEP = 2e-3, CURRENT = 0.17;
/* Table 1 of the paper. */
static const double MASS = 1.23, SPRING = 132.6, VISCOUS = 0.5543, DRY = 0.024, MOMENT = 1.06e-3, INERTIA = 9.5e-5;
static const double TORQUE = 0.08, FORTH = 1.39e-4, BACK = 1.49e-4;

typedef struct { lane position, velocity, angle, turning; } state;

static inline lane smooth_sign(lane x, double width) { return x / ROOT(x * x + width * width); }

/* Equations (1) and (2) of the paper, solved for the accelerations. */
static inline __attribute__((always_inline)) state slope(state at, lane current) {
  lane sine = SINE(at.angle), cosine = COSINE(at.angle), coupling = MOMENT * cosine;
  lane drag = BACK + 0.5 * (FORTH - BACK) * (1.0 + smooth_sign(at.turning, 0.1));
  lane on_arm = TORQUE * current - drag * at.turning;
  lane on_cart = MOMENT * sine * at.turning * at.turning - SPRING * at.position - VISCOUS * at.velocity
                 - DRY * smooth_sign(at.velocity, 1e-3);
  lane scale = 1.0 / (MASS * INERTIA - coupling * coupling);
  return (state){at.velocity, scale * (INERTIA * on_cart - coupling * on_arm), at.turning,
                 scale * (MASS * on_arm - coupling * on_cart)};
}

static inline __attribute__((always_inline)) state moved(state from, double time, state by) {
  return (state){from.position + time * by.position, from.velocity + time * by.velocity, from.angle + time * by.angle,
                 from.turning + time * by.turning};
}

static inline __attribute__((always_inline)) state stepped(state at, lane current) {
  state first = slope(at, current), second = slope(moved(at, 0.5 * STEP, first), current);
  state third = slope(moved(at, 0.5 * STEP, second), current), fourth = slope(moved(at, STEP, third), current);
  return moved(moved(at, STEP / 6, first), STEP / 6, moved(moved(fourth, 2.0, second), 2.0, third));
}

static double seconds(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec + 1e-9 * t.tv_nsec;
}

int main(void) {
  lane *held = aligned_alloc(64, (sizeof(lane) * STEPS * GROUPS + 63) & ~(size_t)63);
  lane *shown = aligned_alloc(64, (2 * sizeof(lane) * STEPS * GROUPS + 63) & ~(size_t)63);
  double best = INFINITY;
  static state at[GROUPS];
  for (long k = 0; k < (long)STEPS * GROUPS * LANES; k++) ((double *)held)[k] = CURRENT * (2.0 * rand() / RAND_MAX - 1.0);
  for (int run = 0; run < RUNS; run++) {
    for (int group = 0; group < GROUPS; group++) at[group] = (state){.position = (lane){0} + 0.02};
    double began = seconds();
    for (int k = 0; k < STEPS; k++)
      for (int group = 0; group < GROUPS; group++) {
        size_t place = (size_t)k * GROUPS + group;
        shown[2 * place] = at[group].position;
        shown[2 * place + 1] = at[group].turning;
        at[group] = stepped(at[group], held[place]);
      }
    double took = (seconds() - began) / STEPS / GROUPS / LANES;
    best = took < best ? took : best;
  }
  printf("%.2f ns (it ends at %.9e m)\n", 1e9 * best, ((double *)&at[0].position)[0]);
  return 0;
}
