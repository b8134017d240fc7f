"""The weights that nav2_amcl and Beluga give a scan, and their parameters; see :mod:`gpusense.world.compat`."""

from gpusense.world.compat import PEERS, Amcl, Beluga, Peer
from gpusense.world.peer_weights import BeamWeights, FieldWeights

__all__ = ["PEERS", "Amcl", "Beluga", "BeamWeights", "FieldWeights", "Peer"]
