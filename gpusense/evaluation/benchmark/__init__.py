"""Error against run time: every way of finding ranges and likelihoods, measured in the same scenes.

``gpusense bench`` runs it. A *scene* is a map with a scanner, a scan and clouds of particles (:mod:`.scenes`), a
*candidate* a way to compute (:mod:`.candidates`), and a *point* what one candidate cost and gave up in one cloud of one
scene on one device (:mod:`.runner`). Errors are against the exact ranges and the models in float64 (:mod:`.accuracy`).
"""
