"""An independent, plain and slow reference: from a problem file to the optimal values.

Written from the documentation of the problem format only; it shares no code with the library and
does not import it. It favours being obviously right over being fast: formulas are evaluated by
Python one sample at a time, transitions are exact fractions, linear algebra is dense.

    model = compile_reference(problem)      # the finite model: rows, costs, causes
    solution = solve_reference(model)       # optimal values, one optimal policy, ties, gamma_bar

Only for trusted input: a formula is handed to Python's `eval`. The input is assumed to be valid.
"""

from reference.compiling import compile_reference as compile_reference
from reference.formulas import formula as formula
from reference.gamma_bar import gamma_bracket as gamma_bracket
from reference.grid import Axis as Axis
from reference.grid import flat as flat
from reference.grid import read_axes as read_axes
from reference.grid import unflat as unflat
from reference.lossless import lossless_cells as lossless_cells
from reference.model import ReferenceModel as ReferenceModel
from reference.policies import Arrays as Arrays
from reference.reaching import classify as classify
from reference.samples import control_vectors as control_vectors
from reference.samples import noise_nodes as noise_nodes
from reference.samples import sample_offsets as sample_offsets
from reference.sets import attractor_cells as attractor_cells
from reference.sets import avoid_cells as avoid_cells
from reference.sets import measure_cells as measure_cells
from reference.solving import ReferenceSolution as ReferenceSolution
from reference.solving import solve_reference as solve_reference
from reference.steps import next_state_function as next_state_function
