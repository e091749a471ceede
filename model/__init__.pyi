from .equations import SignatureFunctions as SignatureFunctions, signatures as signatures
from .known_values import JOINT_KEYS as JOINT_KEYS, KnownValues as KnownValues, nothing_known as nothing_known
from .parameter_names import (
    parameter_descriptions as parameter_descriptions,
    signal_descriptions as signal_descriptions,
)
from .parameters import required_signs as required_signs, standard_parameters as standard_parameters
from .prediction import (
    Model as Model,
    build as build,
    build_cached as build_cached,
    hidden_zeros as hidden_zeros,
    with_given_zeros as with_given_zeros,
    with_least_smoothing as with_least_smoothing,
)
