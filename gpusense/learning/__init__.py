"""Learning the beam model's intrinsic parameters from readings and expected ranges (book section 6.3.3).

``pairs`` classes the readings, ``device_sums`` sums over them on a device, ``problem`` turns sums into the
log-likelihood and its derivatives, ``em``, ``book`` and ``searches`` climb it, ``uncertainty``, ``report`` and
``result`` say how well that went. ``fit`` and ``incidence`` are what users call, with the ``options`` they share.
``discrete`` learns the causes of the discrete model, from counts.
"""
