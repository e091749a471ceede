from .commands import app as app
from .terminal import INTERRUPTED as INTERRUPTED, bar as bar, busy as busy, fail as fail, say as say, table as table
