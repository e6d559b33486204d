"""Push a needle into an ultrasound image: the whole of echospline in a few lines."""

import echospline as es

image = es.sample_image()
mesh = es.RegularGrid.covering(image.grid, (40, 30))
model = es.TPSModel(mesh, clamped=("left", "right", "bottom"))
insertion = es.Insertion.straight(entry=(8.0, 0.0), angle=45.0, depth=30.0, speed=10.0)

for frame in es.simulate(image, insertion, model, fps=10):
    largest = abs(frame.displacement).max()
    print(f"{frame.time:4.1f} s  {frame.pose.depth:4.1f} mm deep  tissue moves by up to {largest:.2f} mm")
