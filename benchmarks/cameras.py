"""Time per camera image in every environment.

    python benchmarks/cameras.py                                         one environment, 64 x 64
    python benchmarks/cameras.py sim.device=cuda batch=64 size=128
    python benchmarks/cameras.py sim.device=cuda batch=64 size=128 picture=rgb

Prints milliseconds per frame and frames per second, without the simulation. The first word may also be any
override of the configuration.
"""

from __future__ import annotations

import statistics
import sys
import time

import numpy as np

import plab
from plab.scenes import Camera
from plab.sim.cameras import CameraSensor

REPEATS = 50


def main() -> None:
    words = {"batch": "1", "size": "64", "picture": "depth"}
    own = [word for word in sys.argv[1:] if word.partition("=")[0] in words]
    words |= dict(word.split("=", 1) for word in own)
    cfg = plab.load_config(["task=Move", *(word for word in sys.argv[1:] if word not in own)])
    batch, size = int(words["batch"]), int(words["size"])
    simulator = plab.Simulator(
        [plab.build_scene(cfg)] * batch, device=cfg.sim.device, precision=cfg.sim.precision
    )
    camera = Camera((0.5, 0.9, 1.6), (0.5, 0.2, 0.5), 40.0, (size, size))
    sensor, like = CameraSensor(simulator, camera), None
    if cfg.sim.device == "cuda":
        import torch

        like = torch.zeros(1, device="cuda")
    actions = np.zeros((batch, simulator.action_dim))
    times = []
    for _ in range(REPEATS):
        simulator.step(actions)
        begin = time.perf_counter()
        sensor.capture(words["picture"], like=like)
        times.append(time.perf_counter() - begin)
    one = statistics.median(times[5:]) / batch
    what = f"{words['picture']} {size} x {size}, {batch} environments"
    print(f"{what}: {1e3 * one:.3f} ms per frame, {1 / one:,.0f} frames/s")


if __name__ == "__main__":
    main()
