"""One step by other libraries: fit a thin plate spline to the landmarks of this frame and evaluate it at every node.

    peers/bin/python benchmarks/peers.py scene.npz 5

Started by steps.py; prints one JSON object: seconds per library and repeat, largest distance (mm) to the exact field, and
versions. scene.npz: nodes (n, 2), landmarks (m, 2), moves (m, 2), exact (n, 2), mm.
"""

import json
import os
import sys
from importlib.metadata import version
from time import perf_counter

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import numpy as np


def scipy_rbf(x, y, d):
    from scipy.interpolate import RBFInterpolator

    return RBFInterpolator(y, d, kernel="thin_plate_spline")(x)


def scikit_image(x, y, d):
    from skimage.transform import ThinPlateSplineTransform

    return ThinPlateSplineTransform.from_estimate(y, y + d)(x) - x


def opencv(x, y, d):
    import cv2

    cv2.setNumThreads(1)
    spline = cv2.createThinPlateSplineShapeTransformer()
    matches = [cv2.DMatch(i, i, 0) for i in range(len(y))]
    spline.estimateTransformation(y.astype(np.float32)[None], (y + d).astype(np.float32)[None], matches)
    return spline.applyTransformation(x.astype(np.float32)[None])[1][0] - x


def vtk_spline(x, y, d):
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

    def points(p):
        made = vtk.vtkPoints()
        made.SetDataTypeToDouble()
        made.SetData(numpy_to_vtk(np.column_stack([p, np.zeros(len(p))])))
        return made

    spline = vtk.vtkThinPlateSplineTransform()
    spline.SetBasisToR2LogR()
    spline.SetSourceLandmarks(points(y))
    spline.SetTargetLandmarks(points(y + d))
    out = vtk.vtkPoints()
    out.SetDataTypeToDouble()
    spline.TransformPoints(points(x), out)
    return vtk_to_numpy(out.GetData())[:, :2] - x


def itk_spline(x, y, d):
    import itk

    spline = itk.ThinPlateR2LogRSplineKernelTransform[itk.D, 2].New()
    kind, sets = type(spline.GetModifiableSourceLandmarks()), []
    for p in (y, y + d):
        points = kind.New()
        for i, (a, b) in enumerate(p):
            points.SetPoint(i, itk.Point[itk.D, 2]([float(a), float(b)]))
        sets.append(points)
    spline.SetSourceLandmarks(sets[0])
    spline.SetTargetLandmarks(sets[1])
    spline.ComputeWMatrix()
    return np.array([tuple(spline.TransformPoint([float(a), float(b)])) for a, b in x]) - x


PEERS = {
    "SciPy RBFInterpolator": (scipy_rbf, "scipy"),
    "scikit-image": (scikit_image, "scikit-image"),
    "OpenCV": (opencv, "opencv-contrib-python-headless"),
    "VTK": (vtk_spline, "vtk"),
    "ITK": (itk_spline, "itk-core"),
}


def main(scene, repeats):
    with np.load(scene) as s:
        x, y, d, exact = (s[k] for k in ("nodes", "landmarks", "moves", "exact"))
    out = {}
    for name, (step, package) in PEERS.items():
        try:
            error = float(np.abs(step(x, y, d) - exact).max())
            seconds = []
            for _ in range(repeats):
                begin = perf_counter()
                step(x, y, d)
                seconds.append(perf_counter() - begin)
            out[name] = {"seconds": seconds, "error_mm": error, "version": version(package)}
        except Exception as error:  # a library that cannot do this scene is named, and the others go on
            out[name] = {"failed": f"{type(error).__name__}: {error}"}
    print(json.dumps(out))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
