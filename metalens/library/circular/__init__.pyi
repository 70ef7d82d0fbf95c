from .turned import GeometricPhase as GeometricPhase
from .turned import check_geometric_phase as check_geometric_phase
from .turned import solve_rotations as solve_rotations
