"""Drives for a person at the levers: from a design for torques to phases that people can follow.

- `prepare` turns a design into a `Sheet`: phases, path, warnings, and the accuracy that simulated people keep.
- `write` puts the driver's sheet (PDF), page (HTML) and phases (CSV) into a folder; `serve` shows the page live.
- `design_phases` designs the phases themselves for the best objective in a person's hands; `as_design` gives the
  result as a design.

A `Trace` is the reference of speed and steering, linear between knots. Torques of such a drive are what the simulated
driver needs to follow it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
