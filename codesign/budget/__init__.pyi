from . import links as links
from . import page as page
from .entry import MEASURED as MEASURED
from .entry import TOTAL as TOTAL
from .entry import BudgetEntry as BudgetEntry
from .entry import quadrature_total as quadrature_total
from .prepared import BudgetInputs as BudgetInputs
from .prepared import prepare_device as prepare_device
