from . import convex as convex
from . import moments as moments
from . import polygon as polygon
from . import rectilinear as rectilinear
from . import region as region
