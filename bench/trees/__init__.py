"""Parts of compare_trees.py: rates and bits of two trees, and the programs that each tree's own process runs."""
