#!/usr/bin/env python3
"""Holds `meshmill compare` against MeshLab's Hausdorff filter.

    peers/deviation.py MESHMILL A B [SAMPLES]

Prints mean, RMS and largest distance each way by both, in the files' units, and exits with 1 where means or RMS are more
than 2 % apart. Both take SAMPLES (1,000,000) over the area; of vertices, MeshLab takes all, and they count for its mean, so
it is asked for samples of faces alone and once more with vertices for the largest distance.
"""

import json
import subprocess
import sys

try:
    import pymeshlab
except ImportError:
    sys.exit("PyMeshLab is not installed: pip install pymeshlab")

if len(sys.argv) not in (4, 5):
    sys.exit(__doc__)
mill, a, b = sys.argv[1:4]
samples = int(sys.argv[4]) if len(sys.argv) == 5 else 1_000_000

said = subprocess.run([mill, "compare", a, b, "--samples", str(samples), "--every-vertex", "--json"],
                      stdout=subprocess.PIPE, check=True)
ours = json.loads(said.stdout)
meshes = pymeshlab.MeshSet()
meshes.load_new_mesh(a)
meshes.load_new_mesh(b)


def theirs(source, target):
    def measure(vertices):
        return meshes.get_hausdorff_distance(
            sampledmesh=source, targetmesh=target, samplevert=vertices, sampleedge=False, samplefauxedge=False,
            sampleface=True, samplenum=samples, maxdist=pymeshlab.PercentageValue(100))
    area, all_points = measure(False), measure(True)
    return {"mean": area["mean"], "rms": area["RMS"], "max": max(area["max"], all_points["max"])}


apart = 0.0
print(f"{'':<10}{'':<6}{'meshmill':>14}{'MeshLab':>14}{'ratio':>9}")
for way, (source, target) in {"a_to_b": (0, 1), "b_to_a": (1, 0)}.items():
    peer = theirs(source, target)
    for key in ("mean", "rms", "max"):
        ratio = ours[way][key] / peer[key] if peer[key] else float(ours[way][key] == 0)
        print(f"{way:<10}{key:<6}{ours[way][key]:>14.6e}{peer[key]:>14.6e}{ratio:>9.4f}")
        if key != "max":
            apart = max(apart, abs(ratio - 1))
sys.exit(0 if apart <= 0.02 else f"means or RMS are {100 * apart:.1f} % apart")
