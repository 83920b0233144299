"""Stabilize the period-two orbit of the standard map (the example of the paper).

Run:  python standard_map.py [figure.png]
"""

import sys
from pathlib import Path

import numpy as np

import lmdsl as lm

problem = lm.load(Path(__file__).with_suffix(".json"))
lp = lm.compile(problem)
print(f"linear program: {lp.A.shape[0]} rows, {lp.A.shape[1]} columns, {lp.A.nnz} nonzeros")

result = lm.solve(lp)
print(f"{result.status}: {result.message}")
print(f"cost {result.cost:.6f}, at least {result.lower_bound:.6f}")
print("the closed loop contracts by", round(result.contraction, 4), "per step")

print("control at (0.1, 0.2):", result.controller([0.1, 0.2]))
run = result.simulate(starts=2000, steps=5000)
print(f"true map: {run.reached} of {run.starts} runs arrive, half in {run.steps['q50']} steps")

if len(sys.argv) > 1:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    shape = result.partition.shape
    control = result.controller.at(np.arange(result.cells))[:, 0].reshape(shape)
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for ax, array, title in zip(
        axes, (control, result.value.reshape(shape)), ("control", "value"), strict=True
    ):
        figure.colorbar(ax.imshow(array.T, origin="lower", extent=(0, 1, 0, 1)), ax=ax)
        ax.set(title=title, xlabel="x", ylabel="y")
    figure.savefig(sys.argv[1])
