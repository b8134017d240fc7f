"""Measure error against run time: every method for ranges and likelihoods, in the same scenes.

``gpusense bench`` runs it. A *scene* is a map with a scanner, a scan and clouds of particles (:mod:`.scenes`). A
*candidate* is a method with its parameters (:mod:`.candidates`). A *point* is the cost and the error of one candidate
in one cloud of one scene on one device (:mod:`.runner`). Errors are against the exact ranges and the models in float64
(:mod:`.accuracy`).
"""
