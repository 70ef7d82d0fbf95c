from . import frames as frames
from . import metrics as metrics
from . import overlay as overlay
from . import picture as picture
from . import sem as sem
