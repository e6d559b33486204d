// Green's function of tissue in the plane: which of two methods answers, and the stations of a needle that it answers.
#pragma once
#include "boundary_green.hpp"
#include "quadratic_green.hpp"
#include "stick_slip.hpp"

namespace echospline::ECHOSPLINE_CORE {

class Green {
 public:
  enum Outcome { done, no_memory, not_held };

  GreenMesh mesh;
  BoundaryGreen boundary;
  QuadraticGreen quadratic;
  bool solves = false;

  Outcome build(const echospline_green_options& o) {
    mesh.build(o);
    solves = o.method == ECHOSPLINE_GREEN_SOLVE;
    if (!solves) return boundary.build(o, mesh) ? done : no_memory;
    switch (quadratic.build(o, mesh)) {
      case QuadraticGreen::done: return done;
      case QuadraticGreen::not_held: return not_held;
      default: return no_memory;
    }
  }

  /// Displacement (.., 2, cases) of mesh nodes and points under load cases; mesh or at may be nullptr. False when memory runs out.
  bool answer(const double* places, int64_t place_count, const double* forces, int64_t cases, const double* points,
              int64_t point_count, double* on_mesh, double* at) const {
    GreenWork work;
    Array<GreenForce> load;
    Array<double> field;
    if (!work.reserve(*this) || !load.reserve(place_count) || !field.reserve(4 * mesh.nodes())) return false;
    const int64_t n = 2 * mesh.nodes();
    for (int64_t k = 0; k < cases; k += 2) {
      const int width = k + 1 < cases ? 2 : 1;
      for (int64_t i = 0; i < place_count; ++i) {
        load[i] = {point_of<2>(places + 2 * i), {}};
        const double* f = forces + 2 * i * cases + k;
        for (int w = 0; w < width; ++w) load[i].force[w] = {{f[w], f[cases + w]}};
      }
      work.solve(*this, load.data(), place_count);
      if (on_mesh) work.field(*this, load.data(), place_count, field.data(), field.data() + n);
      for (int w = 0; w < width; ++w) {
        for (int64_t i = 0; on_mesh && i < n; ++i) on_mesh[i * cases + k + w] = field[w * n + i];
        for (int64_t i = 0; at && i < point_count; ++i) {
          const Vec<2> u = work.at(*this, w, point_of<2>(points + 2 * i), load.data(), place_count);
          for (int d = 0; d < 2; ++d) at[(2 * i + d) * cases + k + w] = u[d];
        }
      }
    }
    return true;
  }

  /// Two solutions, and the room in which they are found.
  struct GreenWork {
    Array<double> solution[2];  ///< strengths, or displacement of the triangles' nodes
    Array<double> load, kept, room;

    bool reserve(const Green& g) {
      const int64_t numbers = g.solves ? g.quadratic.unknowns() : g.boundary.strengths_room();
      if (!solution[0].reserve(numbers) || !solution[1].reserve(numbers)) return false;
      return g.solves ? room.reserve(g.quadratic.solve_room())
                      : load.reserve(g.boundary.load_room()) && kept.reserve(g.boundary.kept_room()) &&
                            room.reserve(g.boundary.field_room());
    }
    void solve(const Green& g, const GreenForce* forces, int64_t count) {
      double *a = solution[0].data(), *b = solution[1].data();
      if (!g.solves) return g.boundary.strengths(forces, count, load.data(), kept.data(), a, b);
      for (int64_t i = 0; i < solution[0].size(); ++i) a[i] = b[i] = 0;
      for (int64_t i = 0; i < count; ++i) g.quadratic.add_load(forces[i], a, b);
      g.quadratic.solve(a, b, room.data());
    }
    /// Displacement of the mesh nodes in both load cases.
    void field(const Green& g, const GreenForce* forces, int64_t count, double* u, double* v) {
      const double *a = solution[0].data(), *b = solution[1].data();
      if (!g.solves) return g.boundary.field(a, b, forces, count, room.data(), u, v);
      for (int64_t i = 0; i < g.mesh.nodes(); ++i) {
        const SixNodes& six = g.quadratic.at_node(i);
        const Vec<2> p = g.quadratic.at(six, a), q = g.quadratic.at(six, b);
        for (int d = 0; d < 2; ++d) u[2 * i + d] = p[d], v[2 * i + d] = q[d];
      }
    }
    Vec<2> at(const Green& g, int w, const Vec<2>& p, const GreenForce* forces, int64_t count) const {
      const double* c = solution[w].data();
      return g.solves ? g.quadratic.at(g.quadratic.locate(p), c) : g.boundary.at(p, c, forces, count, w);
    }
  };
};

/// Answers of a green to the stations of one track: it supplies what a forced tissue asks for.
class GreenStations {
 public:
  const Green* green = nullptr;

  bool attach(const Green* given) {
    if (given && (!work_.reserve(*given) || !field_.reserve(4 * given->mesh.nodes()) ||
                  !columns_.reserve(4 * given->mesh.nodes()) || !rows_.reserve(4 * (MOST_STATIONS + 2))))
      return false;
    green = given;
    return true;
  }

  /// Answer the station that the tissue asks for.
  SlipTissue::Outcome supply(SlipTissue& tissue) {
    const int64_t j = tissue.wanted_index, n = green->mesh.nodes();
    const SlipStation& s = tissue.wanted;
    for (int64_t i = 0; i < 4 * (j + 1); ++i) rows_[i] = 0;
    if (s.count == 0) return tissue.answer(nullptr, rows_.data());
    GreenForce forces[4];  // along x in the first load case, along y in the second
    spread(s, {{1, 0}}, {{0, 1}}, forces);
    if (!reserve(j)) return SlipTissue::no_memory;
    work_.solve(*green, forces, s.count);
    work_.field(*green, forces, s.count, field_.data(), field_.data() + 2 * n);
    for (int64_t i = 0; i < 4 * n; ++i) columns_[i] = static_cast<float>(field_[i]);
    for (int d = 0; d < 2; ++d) {
      const double* solution = work_.solution[d].data();
      const int64_t numbers = work_.solution[d].size();
      if (green->solves)
        for (int64_t i = 0; i < numbers; ++i) solved_[j][d * numbers + i] = static_cast<float>(solution[i]);
      else
        for (int64_t i = 0; i < numbers; ++i) strengths_[j][d * numbers + i] = solution[i];
    }
    if (!green->solves) {
      double* mean = mean_[j].data();
      const int64_t ld = green->boundary.strengths_room();
      for (int64_t i = 0; i < 2 * ld; ++i) mean[i] = 0;
      for (int i = 0; i < s.count; ++i) green->boundary.add_columns(s.points[i], s.weights[i], mean, mean + ld);
    }
    for (int64_t i = 0; i <= j; ++i)
      for (int d = 0; d < 2; ++d) {
        const Vec<2> u = mean_at(i, i == j ? s : tissue.station(i), d, forces, s.count);
        for (int c = 0; c < 2; ++c) rows_[4 * i + 2 * c + d] = u[c];
      }
    return tissue.answer(columns_.data(), rows_.data());
  }

  /// Displacement of points (count, 2) under the tissue's present forces. Every station has been answered.
  bool displacement_at(const SlipTissue& tissue, const double* points, int64_t count, double* u) const {
    const int64_t k = tissue.state.count;
    Array<double> station_force, total;
    Array<GreenForce> forces;
    if (!station_force.reserve(2 * k) || !forces.reserve(4 * k)) return false;
    tissue.forces(station_force.data());
    int64_t used = 0;
    if (!green->solves && !total.reserve(green->boundary.strengths_room())) return false;
    for (int64_t j = 0; j < k; ++j) {
      const Vec<2> f = point_of<2>(&station_force[2 * j]);
      const SlipStation& s = tissue.station(j);
      if ((f[0] == 0 && f[1] == 0) || s.count == 0) {
        station_force[2 * j] = station_force[2 * j + 1] = 0;
        continue;
      }
      if (green->solves) continue;
      spread(s, f, {}, &forces[used]), used += s.count;
      const int64_t numbers = total.size();
      for (int64_t i = 0; i < numbers; ++i) total[i] += f[0] * strengths_[j][i] + f[1] * strengths_[j][numbers + i];
    }
    for (int64_t i = 0; i < count; ++i) {
      const Vec<2> p = point_of<2>(points + 2 * i);
      Vec<2> v = {};
      if (green->solves) {
        const SixNodes six = green->quadratic.locate(p);
        for (int64_t j = 0; j < k; ++j)
          for (int d = 0; d < 2; ++d)
            if (const double f = station_force[2 * j + d]; f != 0)
              v = v + f * green->quadratic.at(six, solved_[j].data() + d * green->quadratic.unknowns());
      } else if (used > 0) {
        v = green->boundary.at(p, total.data(), forces.data(), used, 0);
      }
      u[2 * i] = v[0], u[2 * i + 1] = v[1];
    }
    return true;
  }

 private:
  Green::GreenWork work_;
  Array<double> field_, rows_;
  Array<float> columns_;
  Array<double> strengths_[MOST_STATIONS + 2];  // boundary: of unit forces along x and y
  Array<double> mean_[MOST_STATIONS + 2];  // boundary: rows that take strengths to the mean displacement over a station
  Array<float> solved_[MOST_STATIONS + 2];  // solve: displacement of the triangles' nodes

  static void spread(const SlipStation& s, const Vec<2>& first, const Vec<2>& second, GreenForce* out) {
    for (int i = 0; i < s.count; ++i) out[i] = {s.points[i], {s.weights[i] * first, s.weights[i] * second}};
  }

  bool reserve(int64_t j) {
    if (green->solves)
      return solved_[j].size() == 2 * green->quadratic.unknowns() ||
             solved_[j].reserve(2 * green->quadratic.unknowns());
    const int64_t numbers = 2 * green->boundary.strengths_room();
    return (strengths_[j].size() == numbers || strengths_[j].reserve(numbers)) &&
           (mean_[j].size() == numbers || mean_[j].reserve(numbers));
  }

  /// Mean displacement over station i by the unit force that `work_` holds for direction d.
  Vec<2> mean_at(int64_t i, const SlipStation& s, int d, const GreenForce* forces, int64_t count) const {
    const double* c = work_.solution[d].data();
    Vec<2> u = {};
    if (s.count == 0) return u;
    if (!green->solves) {
      const int64_t ld = green->boundary.strengths_room();
      u = {{dot(mean_[i].data(), c, ld), dot(mean_[i].data() + ld, c, ld)}};
    }
    for (int k = 0; k < s.count; ++k)
      u = u + s.weights[k] * (green->solves ? green->quadratic.at(green->quadratic.locate(s.points[k]), c)
                                            : green->boundary.closed_at(s.points[k], c, forces, count, d));
    return u;
  }
};

/// A forced tissue with what answers it, if the host does not.
struct GreenTissue : SlipTissue {
  GreenStations stations;

  using SlipTissue::SlipTissue;

  /// Repeat a call as long as it asks for a station that is answered here.
  template <class Call>
  Outcome answered_by_green(Call&& call) {
    Outcome outcome = call();
    while (outcome == needs_station && stations.green) {
      outcome = stations.supply(*this);
      if (outcome != done) return outcome;
      outcome = call();
    }
    return outcome;
  }
};

}  // namespace echospline::ECHOSPLINE_CORE
