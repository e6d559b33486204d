"""The law of the needle in space in the core: against the NumPy reference, and Green's function there against Python's."""

import ctypes
from dataclasses import replace

import numpy as np
import pytest

from echospline import _native as core
from echospline._native import space
from echospline.errors import InputError, SolverError
from echospline.mechanics import NeedleForces, SpatialForceModel
from echospline.mechanics.landmarks import SIDES
from echospline.mechanics.space_response import SpaceResponse, block
from echospline.mechanics.spatial_fem_response import SpatialFEMResponse
from echospline.mechanics.spatial_force_model import law_options
from echospline.scene import Region, SpatialPose, Sphere, Tissue

LAW = NeedleForces()
SIZE = (36.0, 32.0, 30.0)
FACES = {
    "free top": {face: "clamped" for face in SIDES if face != "top"},
    "sliding top": {**dict.fromkeys(SIDES, "clamped"), "top": "sliding"},
    "mixed": {"left": "sliding", "right": "free", "bottom": "clamped", "front": "free", "back": "sliding", "top": "free"},
    "clamped top": {"left": "free", "right": "free", "bottom": "sliding", "front": "free", "back": "free", "top": "clamped"},
}  # fmt: skip
MADE = {}


def response(name):
    if name not in MADE:
        grid, clamps = block(SIZE, FACES[name])
        MADE[name] = SpaceResponse(grid, clamps, Tissue(10.0, 0.45), radius=1.5)
    return MADE[name]


def session():
    """In, tilted up and sideways while it cuts, held, half out, in again along the track, out, and in elsewhere."""
    entry, axis = np.array([-9.0, 0.0, -4.0]), np.array([0.5, 0.8, 0.33])
    axis /= np.linalg.norm(axis)

    def pose(depth, tilt=0.0, at=entry, along=axis):
        turned = along + tilt * np.array([0.4, -0.3, 0.5])
        turned /= np.linalg.norm(turned)
        return SpatialPose(tuple(at), tuple(at + depth * turned))

    ways = [*np.linspace(0.0, 14.0, 15)[1:]]
    poses = [pose(d, 0.004 * i) for i, d in enumerate(ways)]
    poses += [pose(14.0, 0.056 - 0.004 * i) for i in range(4)] + [pose(14.0, 0.044)] * 2
    poses += [pose(d, 0.044) for d in (12.0, 9.0, 7.0, 9.0, 13.0, 15.5)]
    poses += [pose(d, 0.044) for d in (10.0, 4.0, 0.5, 0.0)]
    other, down = np.array([6.0, 0.0, 3.0]), np.array([-0.1, 0.99, 0.1])
    return poses + [pose(d, 0.0, other, down) for d in (1.0, 3.0, 6.0, 9.0)]


def run(model, poses, dt=0.1):
    states = [model.rest()]
    for pose in poses:
        states.append(model.advance(states[-1], pose, dt))
    return states


def same(a, b, forces=1e-8):
    assert len(a.forces) == len(b.forces)
    np.testing.assert_allclose(a.forces, b.forces, atol=forces)
    np.testing.assert_allclose(a.force, b.force, atol=10 * forces)
    np.testing.assert_allclose(a.torque, b.torque, atol=200 * forces)
    for name in ("tip", "friction", "side", "cut"):
        assert getattr(a.load, name) == pytest.approx(getattr(b.load, name), abs=20 * forces), name


@pytest.mark.parametrize(
    "law", [LAW, replace(LAW, viscosity=0.05, dead_band=0.15)], ids=["plain", "viscous, play"]
)
@pytest.mark.parametrize("name", ["free top", "mixed"])
def test_the_core_solves_the_law_as_numpy_does(name, law):
    models = [SpatialForceModel(response(name), law, solver=solver) for solver in ("native", "reference")]
    native, reference = (run(model, session()) for model in models)
    for a, b in zip(native, reference, strict=True):
        same(a, b)
        points = np.array([[-4.0, 7.0, -1.0], [0.0, 12.0, 2.0], [5.0, 3.0, 3.0]])
        np.testing.assert_allclose(models[0].field(a)(points), models[1].field(b)(points), atol=2e-6)
    assert max(state.load.tip for state in native) == pytest.approx(LAW.tip, abs=1e-6)
    assert max(state.load.side for state in native) > 0.01
    assert min(state.load.friction for state in native) < -0.01


def test_finite_elements_answer_the_core_too():
    grid, clamps = block(SIZE, FACES["free top"])
    tissue = Tissue(10.0, 0.45, [Region(Sphere((-3.0, 9.0, 0.0), 4.0), 40.0)])
    made = SpatialFEMResponse(grid, clamps, tissue, cell=6.0, radius=1.5)
    native, reference = (
        run(SpatialForceModel(made, LAW, solver=s), session()[:16]) for s in ("native", "reference")
    )
    for a, b in zip(native, reference, strict=True):
        same(a, b)


def test_an_earlier_state_goes_on_as_it_did():
    model = SpatialForceModel(response("free top"), LAW)
    poses = session()
    states = run(model, poses)
    for k in (20, 3, 12, 29):  # among them one that another track follows
        again = model.advance(states[k], poses[k], 0.1)
        same(again, states[k + 1], 1e-12)
        assert [a.station.place.tolist() for a in again.track] == [
            a.station.place.tolist() for a in states[k + 1].track
        ]


def test_a_needle_drawn_out_of_a_loaded_state_leaves_its_track():
    model = SpatialForceModel(response("free top"), LAW)
    states = run(model, session()[:10])
    fresh = SpatialForceModel(response("free top"), LAW)
    away = SpatialPose((0, 0, 0), (0, 0, 0))
    out = fresh.advance(states[-1], away, 0.1)
    assert not out.forces.any()
    assert len(out.track) == len(states[-1].track)
    same(
        fresh.advance(out, session()[9], 0.1),
        model.advance(model.advance(states[-1], away, 0.1), session()[9], 0.1),
        1e-12,
    )


def test_states_of_another_solver_are_refused():
    native, reference = (
        SpatialForceModel(response("free top"), LAW, solver=s) for s in ("native", "reference")
    )
    with pytest.raises(InputError, match="another solver"):
        native.advance(reference.rest(), session()[0], 0.1)
    with pytest.raises(InputError, match="another solver"):
        reference.advance(native.rest(), session()[0], 0.1)
    with pytest.raises(InputError, match="solver is one of native, reference; got 'fast'"):
        SpatialForceModel(response("free top"), LAW, solver="fast")
    other = SpatialForceModel(response("free top"), replace(LAW, tip=0.3))
    with pytest.raises(InputError, match="other options"):
        other.advance(native.rest(), session()[0], 0.1)


class CoreTissue:
    """The core with tables, over the C interface alone."""

    def __init__(self, tables, law=LAW, **changed):
        self.core, self.handle = space.library(), ctypes.c_void_p()
        self.options = o = law_options(law, (np.zeros(3), np.ones(3)))
        self.kept = []
        for name, value in {**tables, **changed}.items():
            if isinstance(value, np.ndarray) and value.size > 3:
                self.kept.append(np.ascontiguousarray(value))
                setattr(o, name, self.kept[-1].ctypes.data)
            elif isinstance(value, np.ndarray):
                getattr(o, name)[:] = value.tolist()
            else:
                setattr(o, name, value)
        o.source_count, o.condition_count = len(tables["sources"]) // 3, len(tables["condition_faces"])
        o.answer_count = len(tables["answers"])
        o.source_count, o.answer_count = (
            changed.get("source_count", o.source_count),
            changed.get("answer_count", o.answer_count),
        )
        self.status = self.core.echospline_spatial_create(ctypes.byref(o), ctypes.byref(self.handle))

    def __del__(self):
        self.core.echospline_spatial_destroy(self.handle)

    def ok(self, status):
        core.check(status, self.core.echospline_spatial_message, self.handle) if status else None

    def advance(self, pose, dt=0.1):
        p = core.Pose(speed=0.0, dt=dt)
        p.entry[:], p.tip[:] = pose.entry, pose.tip
        return self.core.echospline_spatial_advance(self.handle, p)

    def forces(self):
        count, forces = ctypes.c_int64(), np.zeros((600, 3))
        self.ok(self.core.echospline_spatial_forces(self.handle, forces.ctypes.data, 600, count))
        return forces[: count.value]

    def at(self, points):
        field = space.ForceField(struct_size=ctypes.sizeof(space.ForceField))
        self.ok(self.core.echospline_spatial_field(self.handle, field))
        p = np.ascontiguousarray(points, dtype=np.float64)
        u = np.empty_like(p)
        assert self.core.echospline_force_field_at(field, p.ctypes.data, len(p), u.ctypes.data) == 0
        return u

    def save(self):
        size = self.core.echospline_spatial_state_size(self.handle)
        saved = ctypes.create_string_buffer(size)
        self.ok(self.core.echospline_spatial_state_save(self.handle, saved, size))
        return saved.raw

    def load(self, saved):
        return self.core.echospline_spatial_state_load(self.handle, saved, len(saved))


@pytest.mark.parametrize("name", FACES)
def test_the_core_answers_from_tables_as_python_does(name):
    model = SpatialForceModel(response(name), LAW)
    tissue = CoreTissue(response(name).tables())
    tissue.ok(tissue.status)
    points = np.random.default_rng(3).uniform([-17, 0.5, -14], [17, 31, 14], (60, 3))
    most = 0.0
    for state, pose in zip(run(model, session())[1:], session(), strict=True):
        tissue.ok(tissue.advance(pose))
        np.testing.assert_allclose(
            tissue.forces(), state.forces, atol=2e-5
        )  # N; Python's rows are of single precision
        u = model.field(state)(points)
        np.testing.assert_allclose(tissue.at(points), u, atol=2e-4)
        most = max(most, np.abs(u).max())
    assert most > 0.3


def test_a_saved_state_goes_on_bit_for_bit_elsewhere():
    tables, poses = response("free top").tables(), session()
    for k in (4, 17, 27, 30):
        one, other = CoreTissue(tables), CoreTissue(tables)
        for pose in poses[:k]:
            one.ok(one.advance(pose))
        other.ok(other.load(one.save()))
        assert other.save() == one.save()
        points = np.array([[-4.0, 7.0, -1.0], [5.0, 3.0, 3.0]])
        assert (one.at(points) == other.at(points)).all()
        for pose in poses[k : k + 3]:
            one.ok(one.advance(pose))
            other.ok(other.advance(pose))
            assert (one.forces() == other.forces()).all()
        assert other.save() == one.save()


def test_damaged_states_are_refused_and_change_nothing():
    tissue = CoreTissue(response("free top").tables())
    for pose in session()[:5]:
        tissue.ok(tissue.advance(pose))
    saved = tissue.save()
    for at in range(0, len(saved), 7):
        damaged = bytearray(saved)
        damaged[at] ^= 0x41
        assert tissue.load(bytes(damaged)) == core.Status.WRONG_STATE
    for part in (b"", saved[:31], saved[:-8], saved + b"\0" * 104):
        assert tissue.load(part) == core.Status.WRONG_STATE
    assert tissue.save() == saved


def test_without_tables_a_station_is_asked_for():
    tables = response("free top").tables()
    tissue = CoreTissue(tables, source_count=0)
    tissue.ok(tissue.status)
    assert tissue.advance(session()[3]) == core.Status.NEEDS_STATION
    station = space.SpatialStation()
    tissue.ok(tissue.core.echospline_spatial_wanted(tissue.handle, station))
    np.testing.assert_allclose(np.linalg.norm(station.axis), 1)
    assert station.index == 0
    assert sum(station.weights[: station.point_count]) == pytest.approx(1)
    rows = np.zeros(9)
    answer = tissue.core.echospline_spatial_answer
    assert answer(tissue.handle, rows.ctypes.data, 8) == core.Status.WRONG_SIZE
    assert answer(tissue.handle, None, 9) == core.Status.NULL_POINTER
    rows[4] = np.nan
    assert answer(tissue.handle, rows.ctypes.data, 9) == core.Status.WRONG_VALUE
    field = space.ForceField(struct_size=ctypes.sizeof(space.ForceField))
    assert tissue.core.echospline_spatial_field(tissue.handle, field) == core.Status.WRONG_VALUE


def test_answers_that_are_no_compliance_are_said():
    class Wrong(SpaceResponse):
        def column_at(self, column, points):
            return -super().column_at(column, points)

    grid, clamps = block(SIZE, FACES["free top"])
    model = SpatialForceModel(Wrong(grid, clamps, Tissue(10.0, 0.45), radius=1.5), LAW)
    with pytest.raises(SolverError, match="symmetric positive compliance"):
        run(model, session()[:6])


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"poisson": 0.5}, "poisson must lie"),
        ({"radius": float("nan")}, "radius must be"),
        ({"clamped": 64}, "bits of the six faces"),
        ({"sliding": 1, "clamped": 1}, "none in both"),
        ({"top": 7}, "top must be"),
        ({"answer_count": 12}, "answers must hold"),
        ({"low": np.array([-18.0, 3.0, -15.0])}, "begin at y = 0"),
        ({"lattice_shape": np.array([3, 5, 5])}, "lattice_shape must be"),
        ({"lattice_spacing": np.array([1.0, 0.0, 1.0])}, "lattice_spacing must be"),
        ({"source_count": 100_000}, "source_count must be"),
        ({"tip": -1.0}, "tip must be"),
        ({"station_spacing": 0.01}, "station_spacing must be"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_a_sentence(changed, match):
    tissue = CoreTissue(response("free top").tables(), **changed)
    with pytest.raises(InputError, match=match):
        tissue.ok(tissue.status)
    assert tissue.advance(session()[0]) == core.Status.FAILED_HANDLE


def test_faces_and_sources_of_the_tables_are_checked():
    tables = response("free top").tables()
    faces, sources = tables["condition_faces"].copy(), tables["sources"].copy()
    faces[3], sources[4] = 4, -1.0
    for changed, match in (
        ({"condition_faces": faces}, "one bit each"),
        ({"sources": sources}, "below the surface"),
    ):
        tissue = CoreTissue({**tables, **changed})
        with pytest.raises(InputError, match=match):
            tissue.ok(tissue.status)
