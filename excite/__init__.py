"""Excitation trajectories for dynamic machines: design, simulation, identification, diagnosis.

    import excite

    drive = excite.design("va12_straight")                  # a test drive that excites every parameter
    log = excite.simulate("va12_straight", drive, seed=1)   # what the sensors would write, as a DataFrame
    estimate = excite.identify("va12_straight", log)        # parameters with 95 % intervals

`load` and `read_log` give the records that these work on, `predict` gives the signals of another drive with 95 % bands,
`score`, `verify` and `compare` judge drives, `campaign` designs the fewest drives that attain an accuracy, `diagnose`
finds what the model gets wrong, `slip` fits contact laws. Everything else is in the packages: `excite.model`,
`simulation`, `logs`, `smoothing`, `identification`, `trajectories`, `diagnosis`, `reports`, `operator`, `workflows`,
`cli`, each importing from those before it only.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
