"""Evaluate devices, models and logs: proofs, self-test, stiff cases, scores, held-out likelihood and benchmarks."""
