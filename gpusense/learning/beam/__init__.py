"""Learn the parameters of the beam model from readings and expected ranges (book section 6.3.3).

``fit`` and ``incidence`` hold the public functions. ``pairs`` classifies the readings, ``device_sums`` checks the
options and sums over the pairs on a device, ``problem`` computes the log-likelihood and its derivatives from the sums.
``em`` maximises it from the starts of ``optimum``; ``report`` describes the result.
"""
