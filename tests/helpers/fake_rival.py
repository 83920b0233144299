"""Contestants that misbehave, for test_benchmarks.py; imported by the workers of the benchmarks."""

import os
import signal
import time

import numpy as np


class Solver:
    def __init__(self, model, algorithm):
        self.model, self.algorithm, self.solves = model, algorithm, 0
        self.small = model.n < 60  # the model that warms up: all behave there
        if algorithm == "cannot build" and not self.small:
            raise MemoryError("no room")

    def renew(self):
        self.solves += 1

    def solve(self):
        if self.small:
            return
        match self.algorithm:
            case "raises":
                raise ZeroDivisionError("by nothing")
            case "exits":
                os._exit(3)
            case "is killed":
                os.kill(os.getpid(), signal.SIGKILL)
            case "hangs":
                time.sleep(1000)
            case "hangs later" if self.solves > 2:
                time.sleep(1000)
            case "is slow":
                time.sleep(0.6)
            case "prints":
                print('{"wall": -1}', flush=True)
                os.write(1, b'{"wall": -1}\n')
            case "is unable":
                raise NotImplementedError("not this form")

    def value(self):
        V = self.model.upper.copy()
        match self.algorithm:
            case "lies":
                V[0] *= 1 + 1e-4
            case "lies later" if self.solves > 2:
                V[0] *= 1 - 1e-4
            case "returns nan":
                V[0] = np.nan
            case "returns too few":
                V = V[1:]
        return V
