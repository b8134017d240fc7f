"""The parts of compare_trees.py: rates and bits of two trees, and the programs that run in a tree's own process."""
