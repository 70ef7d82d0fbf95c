from .as_written import LensRows as LensRows
from .exposure import ExposedRows as ExposedRows
from .exposure import verify_exposure as verify_exposure
from .report import ExposureReport as ExposureReport
