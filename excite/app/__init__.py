"""The window for a test day: `excite app` serves one page, on this computer alone, from machine to named cause.

Each step is a command, run as a process of its own (`Job`) that reports progress and can be stopped; its result is the
folder that the command writes. What the day has come to is read from these folders (`Day`), so the window and the
command line may take turns, and every browser shows the same.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
