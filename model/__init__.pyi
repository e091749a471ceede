from .equations import Signatures as Signatures, signatures as signatures
from .parameter_names import meanings as meanings
from .prediction import (
    Model as Model,
    build as build,
    built as built,
    signs as signs,
    standard_parameters as standard_parameters,
)
