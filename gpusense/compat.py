"""The weights that nav2_amcl and Beluga give a scan, and their parameters; see :mod:`gpusense.world.compat`."""

from gpusense.world.compat import PEERS, BeamWeights, FieldWeights, Peer

__all__ = ["PEERS", "BeamWeights", "FieldWeights", "Peer"]
