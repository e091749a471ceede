from .commands import app as app
from .terminal import INTERRUPTED as INTERRUPTED, fail as fail
