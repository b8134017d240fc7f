"""Learn the parameters of the beam model from readings and expected ranges (book section 6.3.3).

``fit`` and ``incidence`` hold the public functions, and ``options`` their common options. ``pairs`` classifies the
readings, ``device_sums`` sums over them on a device, ``problem`` computes the log-likelihood and its derivatives from
the sums. ``em``, ``textbook`` and ``searches`` maximise it; ``report`` describes the result.
"""
