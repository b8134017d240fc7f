"""The package of gpusense's nodes for colcon; their code is gpusense.ros."""
