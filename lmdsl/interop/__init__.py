"""Bridges to other packages: Gymnasium both ways, python-control both ways, labelled arrays.

Each function imports its package when it is called; ``pip install 'lmdsl[gymnasium]'`` and so on
bring them.
"""

from lmdsl.interop.gym_systems import from_gym
from lmdsl.interop.gymnasium import gym_env, policy
from lmdsl.interop.linear import state_space, with_gain
from lmdsl.interop.python_control import closed_loop_system, control_system, controller_system

__all__ = [
    "closed_loop_system",
    "control_system",
    "controller_system",
    "from_gym",
    "gym_env",
    "policy",
    "state_space",
    "with_gain",
]
