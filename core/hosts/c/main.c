/*
 * A simulator's loop in C: the needle goes in and out, 1000 steps a second, and the tissue under it follows.
 *
 *     host [seconds] [rate] [width depth]
 *
 * seconds   how long, 5 by default
 * rate      steps per second, 1000 by default
 * width depth   nodes of the mesh along each axis, 40 30 by default; the tissue is 40 mm wide and 30 mm deep
 *
 * Once a second it prints where the tip is, how far the tissue is displaced and how long steps took; in the end the quantiles of all steps
 * and what the core allocated in the loop, which has to be nothing. It waits by sleeping until the next step is due.
 */
#define _POSIX_C_SOURCE 200809L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "echospline/echospline.h"

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void sleep_until(double when) {
  const double rest = when - now();
  if (rest <= 0) return;
  const struct timespec t = {(time_t)rest, (long)(1e9 * (rest - floor(rest)))};
  nanosleep(&t, NULL);
}

static int ascending(const void* a, const void* b) {
  const float x = *(const float*)a, y = *(const float*)b;
  return (x > y) - (x < y);
}

static float quantile(const float* sorted, long count, double share) {
  const long k = (long)(share * (double)count);
  return sorted[k < count ? k : count - 1];
}

int main(int argument_count, char** arguments) {
  const double seconds = argument_count > 1 ? atof(arguments[1]) : 5;
  const double rate = argument_count > 2 ? atof(arguments[2]) : 1000;
  const int width = argument_count > 4 ? atoi(arguments[3]) : 40, depth = argument_count > 4 ? atoi(arguments[4]) : 30;
  if (!(seconds > 0 && rate > 0 && width > 1 && depth > 1)) {
    fprintf(stderr,
            "usage: host [seconds] [rate] [width depth]; all of them positive, 2 nodes or more along each axis\n");
    return 2;
  }

  echospline_scene_options options = {.struct_size = sizeof options};
  echospline_scene_defaults(&options);
  options.shape[0] = width, options.shape[1] = depth;
  options.spacing[0] = 40.0 / (width - 1), options.spacing[1] = 30.0 / (depth - 1);

  echospline_scene* scene = NULL;
  echospline_tissue* tissue = NULL;
  const long steps = (long)ceil(seconds * rate);
  const int64_t nodes = (int64_t)width * depth;
  float* field = malloc((size_t)(2 * nodes) * sizeof *field);
  float* took = malloc((size_t)steps * sizeof *took);
  int result = 1;
  if (!field || !took) {
    fprintf(stderr, "no memory for %ld steps\n", steps);
    goto end;
  }
  if (echospline_scene_create(&options, &scene) != ECHOSPLINE_OK) {
    fprintf(stderr, "%s\n", echospline_scene_message(scene));
    goto end;
  }
  if (echospline_tissue_create(scene, &tissue) != ECHOSPLINE_OK) {
    fprintf(stderr, "%s\n", echospline_tissue_message(tissue));
    goto end;
  }
  printf("echospline %d.%d.%d, level %s, %lld nodes, %.0f steps a second\n", ECHOSPLINE_VERSION_MAJOR,
         ECHOSPLINE_VERSION_MINOR, ECHOSPLINE_VERSION_PATCH, echospline_level_name(echospline_scene_level(scene)),
         (long long)nodes, rate);
  printf("%6s %8s %8s %16s %10s %10s\n", "time s", "tip x", "tip y", "displacement mm", "mean us", "worst us");

  const echospline_command in = {.entry = {8, 0, 0}, .tip = {26, 18, 0}, .lag = 0.08, .fastest = 20};
  const echospline_command out = {.entry = {8, 0, 0}, .tip = {9, 1, 0}, .lag = 0.08, .fastest = 20};
  echospline_pose pose = {.entry = {8, 0, 0}, .tip = {9, 1, 0}, .dt = 1 / rate};
  double sum = 0, worst = 0;
  long since = 0;
  const double begin = now();
  for (long step = 0; step < steps; ++step) {
    sleep_until(begin + (double)step / rate);
    const int inwards = fmod((double)step / rate, 4.0) < 2.0; /* two seconds in, two seconds out */
    if (echospline_follow(&pose, inwards ? &in : &out, &pose) != ECHOSPLINE_OK) goto end;
    const double start = now();
    echospline_status status = echospline_advance(tissue, &pose);
    if (status == ECHOSPLINE_OK) status = echospline_displacement_single(tissue, field, 2 * nodes);
    const double spent = now() - start;
    if (status != ECHOSPLINE_OK) {
      fprintf(stderr, "step %ld: %s\n", step, echospline_tissue_message(tissue));
      goto end;
    }
    took[step] = (float)(1e6 * spent);
    sum += spent, worst = fmax(worst, spent), ++since;
    if ((step + 1) % (long)ceil(rate) == 0 || step + 1 == steps) {
      float largest = 0;
      for (int64_t i = 0; i < nodes; ++i) largest = fmaxf(largest, hypotf(field[2 * i], field[2 * i + 1]));
      printf("%6.2f %8.3f %8.3f %16.3f %10.1f %10.1f\n", (double)(step + 1) / rate, pose.tip[0], pose.tip[1],
             (double)largest, 1e6 * sum / (double)since, 1e6 * worst);
      fflush(stdout);
      sum = worst = 0, since = 0;
    }
  }

  echospline_statistics statistics = {.struct_size = sizeof statistics};
  if (echospline_tissue_statistics(tissue, &statistics) != ECHOSPLINE_OK) goto end;
  qsort(took, (size_t)steps, sizeof *took, ascending);
  printf("steps %lld, contacts joined %lld, left %lld, held back %lld, allocations in the loop %lld\n",
         (long long)statistics.steps, (long long)statistics.joined, (long long)statistics.left,
         (long long)statistics.held_back, (long long)statistics.allocations);
  printf("step us: p50 %.1f, p99 %.1f, p99.9 %.1f, max %.1f\n", (double)quantile(took, steps, 0.5),
         (double)quantile(took, steps, 0.99), (double)quantile(took, steps, 0.999), (double)took[steps - 1]);
  result = statistics.allocations == 0 ? 0 : 1;
end:
  echospline_tissue_destroy(tissue);
  echospline_scene_destroy(scene);
  free(field);
  free(took);
  return result;
}
