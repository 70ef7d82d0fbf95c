from .case import case_of as case_of
from .engine import solve as solve
from .engine import solve_on_mesh as solve_on_mesh
from .ladder import RUNGS as RUNGS
from .ladder import MeshLevel as MeshLevel
from .ladder import first_rung as first_rung
