/* The C interface is pinned: the header compiles as C17 and as C++20, and sizes, offsets and enum values never change unnoticed. */
#include "echospline/echospline.h"
#include "echospline/green.h"

#include <assert.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

#define VALUE(name, value) static_assert((int)ECHOSPLINE_##name == value, #name)

VALUE(OK, 0);
VALUE(NULL_POINTER, 1);
VALUE(WRONG_SIZE, 2);
VALUE(WRONG_VALUE, 3);
VALUE(OUT_OF_MEMORY, 4);
VALUE(NOT_HELD, 5);
VALUE(NOT_SOLVED, 6);
VALUE(WRONG_STATE, 7);
VALUE(FAILED_HANDLE, 8);
VALUE(NEEDS_STATION, 9);
VALUE(LEVEL_BEST, 0);
VALUE(LEVEL_BASELINE, 1);
VALUE(LEVEL_AVX2, 2);
VALUE(LEVEL_AVX512, 3);
VALUE(LEVEL_NEON, 4);
VALUE(LEVEL_SIMD128, 5);
VALUE(THIN_PLATE, 0);
VALUE(ELASTIC, 1);
VALUE(SINGLE, 0);
VALUE(DOUBLE, 1);
VALUE(TIP_POINT, 0);
VALUE(TIP_NODE, 1);
VALUE(FOLLOW, 0);
VALUE(IMMEDIATE, 1);
VALUE(STICK, 2);
VALUE(PLANE_STRESS, 0);
VALUE(PLANE_STRAIN, 1);
VALUE(LEFT, 1);
VALUE(RIGHT, 2);
VALUE(TOP, 4);
VALUE(BOTTOM, 8);
VALUE(FRONT, 16);
VALUE(BACK, 32);
VALUE(CONTACT, 0);
VALUE(LEAVING, 1);
VALUE(TIP, 2);
VALUE(TIP_LEFT, 3);
VALUE(UINT8, 0);
VALUE(UINT16, 1);
VALUE(INT16, 2);
VALUE(FLOAT32, 3);
VALUE(LINEAR, 0);
VALUE(NEAREST, 1);
VALUE(BORDER_VALUE, 0);
VALUE(BORDER_TRANSPARENT, 1);
VALUE(METHOD_AUTO, 0);
VALUE(METHOD_EXACT, 1);
VALUE(METHOD_PULL, 2);
VALUE(SHAFT, 1);
VALUE(BEVEL, 2);
VALUE(TAIL, 4);
VALUE(SHADOW, 8);
VALUE(GREEN_BOUNDARY, 0);
VALUE(GREEN_SOLVE, 1);
VALUE(CONDITION_CLAMPED, 0);
VALUE(CONDITION_SLIDING_X, 1);
VALUE(CONDITION_SLIDING_Y, 2);
VALUE(CONDITION_FREE, 3);
VALUE(CONDITION_INTERFACE, 4);

#if UINTPTR_MAX == UINT64_MAX
#define SIZE(type, size) static_assert(sizeof(type) == size, #type)
#define OFFSET(type, member, offset) static_assert(offsetof(type, member) == offset, #type "." #member)

SIZE(echospline_scene_options, 240);
OFFSET(echospline_scene_options, struct_size, 0);
OFFSET(echospline_scene_options, dimension, 4);
OFFSET(echospline_scene_options, kernel, 8);
OFFSET(echospline_scene_options, precision, 12);
OFFSET(echospline_scene_options, tip, 16);
OFFSET(echospline_scene_options, loading, 20);
OFFSET(echospline_scene_options, plane, 24);
OFFSET(echospline_scene_options, clamped, 28);
OFFSET(echospline_scene_options, level, 32);
OFFSET(echospline_scene_options, shape, 36);
OFFSET(echospline_scene_options, spacing, 48);
OFFSET(echospline_scene_options, origin, 72);
OFFSET(echospline_scene_options, sigma, 96);
OFFSET(echospline_scene_options, delta, 104);
OFFSET(echospline_scene_options, alpha1, 112);
OFFSET(echospline_scene_options, alpha2, 120);
OFFSET(echospline_scene_options, alpha3, 128);
OFFSET(echospline_scene_options, length, 136);
OFFSET(echospline_scene_options, drag, 144);
OFFSET(echospline_scene_options, contact_spacing, 152);
OFFSET(echospline_scene_options, anchor_spacing, 160);
OFFSET(echospline_scene_options, poisson, 168);
OFFSET(echospline_scene_options, radius, 176);
OFFSET(echospline_scene_options, clamped_points, 184);
OFFSET(echospline_scene_options, clamped_point_count, 192);
OFFSET(echospline_scene_options, stiffness, 200);
OFFSET(echospline_scene_options, stiffness_count, 208);
OFFSET(echospline_scene_options, contact_room, 216);
OFFSET(echospline_scene_options, sliding, 224);
OFFSET(echospline_scene_options, reserved, 228);
OFFSET(echospline_scene_options, friction_speed, 232);

SIZE(echospline_pose, 64);
OFFSET(echospline_pose, entry, 0);
OFFSET(echospline_pose, tip, 24);
OFFSET(echospline_pose, speed, 48);
OFFSET(echospline_pose, dt, 56);

SIZE(echospline_command, 64);
OFFSET(echospline_command, entry, 0);
OFFSET(echospline_command, tip, 24);
OFFSET(echospline_command, lag, 48);
OFFSET(echospline_command, fastest, 56);

SIZE(echospline_landmark, 96);
OFFSET(echospline_landmark, place, 0);
OFFSET(echospline_landmark, displacement, 24);
OFFSET(echospline_landmark, grip, 48);
OFFSET(echospline_landmark, along, 72);
OFFSET(echospline_landmark, node, 80);
OFFSET(echospline_landmark, kind, 88);
OFFSET(echospline_landmark, reserved, 92);

SIZE(echospline_statistics, 64);
OFFSET(echospline_statistics, struct_size, 0);
OFFSET(echospline_statistics, reserved, 4);
OFFSET(echospline_statistics, steps, 8);
OFFSET(echospline_statistics, joined, 16);
OFFSET(echospline_statistics, left, 24);
OFFSET(echospline_statistics, rebuilt, 32);
OFFSET(echospline_statistics, held_back, 40);
OFFSET(echospline_statistics, allocations, 48);
OFFSET(echospline_statistics, residual, 56);

SIZE(echospline_picture_options, 128);
OFFSET(echospline_picture_options, struct_size, 0);
OFFSET(echospline_picture_options, pixel_type, 4);
OFFSET(echospline_picture_options, channels, 8);
OFFSET(echospline_picture_options, interpolation, 12);
OFFSET(echospline_picture_options, border, 16);
OFFSET(echospline_picture_options, method, 20);
OFFSET(echospline_picture_options, level, 24);
OFFSET(echospline_picture_options, columns, 28);
OFFSET(echospline_picture_options, rows, 32);
OFFSET(echospline_picture_options, mesh_shape, 36);
OFFSET(echospline_picture_options, reserved, 44);
OFFSET(echospline_picture_options, spacing, 48);
OFFSET(echospline_picture_options, origin, 64);
OFFSET(echospline_picture_options, mesh_spacing, 80);
OFFSET(echospline_picture_options, mesh_origin, 96);
OFFSET(echospline_picture_options, border_value, 112);
OFFSET(echospline_picture_options, white, 120);

SIZE(echospline_needle, 240);
OFFSET(echospline_needle, struct_size, 0);
OFFSET(echospline_needle, parts, 4);
OFFSET(echospline_needle, seed, 8);
OFFSET(echospline_needle, curved, 12);
OFFSET(echospline_needle, entry, 16);
OFFSET(echospline_needle, tip, 40);
OFFSET(echospline_needle, apex, 64);
OFFSET(echospline_needle, diameter, 80);
OFFSET(echospline_needle, lateral, 88);
OFFSET(echospline_needle, axial, 96);
OFFSET(echospline_needle, elevation, 104);
OFFSET(echospline_needle, elevation_depth, 112);
OFFSET(echospline_needle, element_height, 120);
OFFSET(echospline_needle, f_number, 128);
OFFSET(echospline_needle, dynamic_range, 136);
OFFSET(echospline_needle, specular, 144);
OFFSET(echospline_needle, lobe, 152);
OFFSET(echospline_needle, lobe_elevation, 160);
OFFSET(echospline_needle, steering, 168);
OFFSET(echospline_needle, roughness, 176);
OFFSET(echospline_needle, rolloff, 184);
OFFSET(echospline_needle, wobble, 192);
OFFSET(echospline_needle, patches, 200);
OFFSET(echospline_needle, bevel, 208);
OFFSET(echospline_needle, ring_down, 216);
OFFSET(echospline_needle, ring_down_loss, 224);
OFFSET(echospline_needle, opacity, 232);

SIZE(echospline_picture_report, 64);
OFFSET(echospline_picture_report, struct_size, 0);
OFFSET(echospline_picture_report, method, 4);
OFFSET(echospline_picture_report, residual, 8);
OFFSET(echospline_picture_report, difference, 16);
OFFSET(echospline_picture_report, exact_share, 24);
OFFSET(echospline_picture_report, folded_cells, 32);
OFFSET(echospline_picture_report, smallest_jacobian, 40);
OFFSET(echospline_picture_report, place, 48);

SIZE(echospline_look, 112);
OFFSET(echospline_look, struct_size, 0);
OFFSET(echospline_look, level, 4);
OFFSET(echospline_look, invert, 8);
OFFSET(echospline_look, flip, 12);
OFFSET(echospline_look, gain, 16);
OFFSET(echospline_look, recorded_range, 24);
OFFSET(echospline_look, dynamic_range, 32);
OFFSET(echospline_look, depth_gain_count, 40);
OFFSET(echospline_look, reserved, 44);
OFFSET(echospline_look, depth_gains, 48);

SIZE(echospline_forced_options, 120);
OFFSET(echospline_forced_options, struct_size, 0);
OFFSET(echospline_forced_options, level, 4);
OFFSET(echospline_forced_options, node_count, 8);
OFFSET(echospline_forced_options, low, 16);
OFFSET(echospline_forced_options, high, 32);
OFFSET(echospline_forced_options, tip, 48);
OFFSET(echospline_forced_options, friction_limit, 56);
OFFSET(echospline_forced_options, bond, 64);
OFFSET(echospline_forced_options, tip_stiffness, 72);
OFFSET(echospline_forced_options, side_stiffness, 80);
OFFSET(echospline_forced_options, viscosity, 88);
OFFSET(echospline_forced_options, station_spacing, 96);
OFFSET(echospline_forced_options, substep, 104);
OFFSET(echospline_forced_options, dead_band, 112);

SIZE(echospline_station, 144);
OFFSET(echospline_station, index, 0);
OFFSET(echospline_station, place, 8);
OFFSET(echospline_station, axis, 24);
OFFSET(echospline_station, points, 40);
OFFSET(echospline_station, weights, 104);
OFFSET(echospline_station, point_count, 136);
OFFSET(echospline_station, reserved, 140);

SIZE(echospline_needle_load, 40);
OFFSET(echospline_needle_load, tip, 0);
OFFSET(echospline_needle_load, friction, 8);
OFFSET(echospline_needle_load, side, 16);
OFFSET(echospline_needle_load, torque, 24);
OFFSET(echospline_needle_load, cut, 32);

SIZE(echospline_green_options, 304);
OFFSET(echospline_green_options, struct_size, 0);
OFFSET(echospline_green_options, level, 4);
OFFSET(echospline_green_options, method, 8);
OFFSET(echospline_green_options, clamped, 12);
OFFSET(echospline_green_options, sliding, 16);
OFFSET(echospline_green_options, shape, 20);
OFFSET(echospline_green_options, reserved, 28);
OFFSET(echospline_green_options, spacing, 32);
OFFSET(echospline_green_options, origin, 48);
OFFSET(echospline_green_options, radius, 64);
OFFSET(echospline_green_options, weight, 72);
OFFSET(echospline_green_options, pin_weight, 80);
OFFSET(echospline_green_options, pin_radius, 88);
OFFSET(echospline_green_options, lattice, 96);
OFFSET(echospline_green_options, bodies, 104);
OFFSET(echospline_green_options, depths, 112);
OFFSET(echospline_green_options, circles, 120);
OFFSET(echospline_green_options, sources, 128);
OFFSET(echospline_green_options, source_counts, 136);
OFFSET(echospline_green_options, conditions, 144);
OFFSET(echospline_green_options, sides, 152);
OFFSET(echospline_green_options, pins, 160);
OFFSET(echospline_green_options, order, 168);
OFFSET(echospline_green_options, right, 176);
OFFSET(echospline_green_options, left, 184);
OFFSET(echospline_green_options, body_count, 192);
OFFSET(echospline_green_options, band_count, 200);
OFFSET(echospline_green_options, source_count, 208);
OFFSET(echospline_green_options, condition_count, 216);
OFFSET(echospline_green_options, pin_count, 224);
OFFSET(echospline_green_options, rank, 232);
OFFSET(echospline_green_options, lines_x, 240);
OFFSET(echospline_green_options, lines_y, 248);
OFFSET(echospline_green_options, moduli, 256);
OFFSET(echospline_green_options, held, 264);
OFFSET(echospline_green_options, line_x_count, 272);
OFFSET(echospline_green_options, line_y_count, 280);
OFFSET(echospline_green_options, triangle_count, 288);
OFFSET(echospline_green_options, held_count, 296);
#endif

int main(void) {
  const uint32_t header =
      (uint32_t)ECHOSPLINE_VERSION_MAJOR << 16 | ECHOSPLINE_VERSION_MINOR << 8 | ECHOSPLINE_VERSION_PATCH;
  if (echospline_version() != header) {
    printf("echospline_version() is %u, the header says %u\n", (unsigned)echospline_version(), (unsigned)header);
    return 1;
  }
  return 0;
}
