from .interface import (
    __version__ as __version__,
    campaign as campaign,
    compare as compare,
    design as design,
    diagnose as diagnose,
    identify as identify,
    load as load,
    predict as predict,
    read_log as read_log,
    score as score,
    simulate as simulate,
    verify as verify,
)
