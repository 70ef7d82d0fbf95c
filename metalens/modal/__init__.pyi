from .case import case_of as case_of
from .solver import LEVELS as LEVELS
from .solver import refine_case as refine_case
from .solver import solve as solve
from .solver import solve_on_mesh as solve_on_mesh
