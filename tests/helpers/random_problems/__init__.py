"""Small valid problems: a seeded generator of many kinds, and hand-written corner cases.

`random_problem(rng)` returns the dict of a problem file. Its geometry is generic: no image lies
where the last bit of a sine decides its cell. The corner cases do lie on edges, with arithmetic
that doubles carry out exactly.
"""

from random_problems.corner_cases import CORNER_CASES as CORNER_CASES
from random_problems.drawing import attempt as attempt
from random_problems.drawing import describe as describe
from random_problems.drawing import random_problem as random_problem
