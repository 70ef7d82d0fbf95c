from . import page as page
from .focus import check_study_lens as check_study_lens
