"""The noises of a system, in either of two descriptions of one structure.

    w_k enters x_{k+1},  k >= 0;     v^i_k is in y^i_k,  k >= 1;     all of zero mean, and of the covariances
    Cov[w_k, w_k], Cov[w_k, w_{k-1}], Cov[v^i_k, v^j_k], Cov[v^i_k, v^j_{k-1}], Cov[w_k, v^i_{k, k+1, k+2}], no others

`MovingAverageNoise` builds them from white noises and derives the covariances; `CovarianceNoise` starts from the
covariances. Both refuse what the filters cannot represent.
"""

from zfusion.model.covariance_noise import CovarianceNoise
from zfusion.model.moving_average import MovingAverageNoise, Tap, WhiteNoise
from zfusion.model.noise_model import NoiseCovariances, NoiseModel

__all__ = ["CovarianceNoise", "MovingAverageNoise", "NoiseCovariances", "NoiseModel", "Tap", "WhiteNoise"]
