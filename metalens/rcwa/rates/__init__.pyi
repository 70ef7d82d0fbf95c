from .verb import JonesDerivatives as JonesDerivatives
from .verb import ParameterDerivative as ParameterDerivative
from .verb import jones_derivatives as jones_derivatives
