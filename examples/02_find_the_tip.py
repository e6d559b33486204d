"""Sweep a probe across a needle and find its tip: the last picture in which the shaft is a bright spot."""

import numpy as np

import echospline as es

speckle = np.random.default_rng(0).rayleigh(25.0, (60, 70, 80)).clip(0, 255).astype(np.uint8)  # z, y, x
tissue = es.Volume(speckle, spacing=(0.5, 0.5, 0.5), origin=(-20.0, 0.0, -15.0))
model = es.SpatialForceModel.green(tissue.mesh((21, 18, 16)))
needle = es.SpatialInsertion.straight(
    entry=(-14.0, 0.0, 1.0), direction=(1.0, 1.0, 0.1), depth=24.0, speed=24.0
)
probe = es.Probe(width=24.0, depth=30.0, pixel=0.2, elevation=0.5)

# the needle goes in for a second; then the probe, held across it, sweeps along x at 5 mm/s
planes = [es.probe_plane((x, 0.0, 0.0), yaw=90.0) for x in (-8.0, 12.0)]
path = es.PlanePath([1.0, 5.0], planes)
for frame in es.simulate(tissue, needle, model, probe=probe, plane=path, fps=20, needle=es.NeedleEcho()):
    row, column = np.unravel_index(frame.image.pixels.argmax(), frame.image.pixels.shape)
    if frame.time >= 1.0 and frame.image.pixels[row, column] > 220:
        tip = frame.plane.lift(np.array([[probe.grid.x[column], probe.grid.y[row]]]))[0]
print(f"tip found at {tip.round(1)} mm; it is at {np.round(frame.pose.tip, 1)} mm")
