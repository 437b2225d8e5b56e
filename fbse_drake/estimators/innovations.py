"""What innovations say of noise and models, for all filters.

White innovations differ from tick to tick; what they keep saying is no noise but something that the
model lacks.
"""

# For how long innovations must agree to be no white noise [s], and how much larger than white noise
# leaves it their mean square must be.
AGREEMENT_TIME, AGREEMENT = 0.02, 3.0
# How long it takes to learn that sensors are noisier than believed [s], and how much of that one
# tick may tell, as a share of the variance.
NOISE_TIME, LARGEST_SHARE = 0.3, 9.0
