from .angles import OverField as OverField
from .angles import frequencies_per_mm as frequencies_per_mm
from .angles import over_field as over_field
from .chief import ChiefRay as ChiefRay
from .chief import chief_ray as chief_ray
