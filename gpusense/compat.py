"""The weights that nav2_amcl and Beluga give a scan, and their parameters; see :mod:`gpusense.peers.weights`.

:func:`from_nav2` reads the parameters of nav2_amcl's node, :mod:`gpusense.localization.nav2`.
"""

from gpusense.localization.nav2 import Nav2Options, from_nav2
from gpusense.peers.weights import PEERS, Amcl, BeamWeights, Beluga, FieldWeights, Peer

__all__ = ["PEERS", "Amcl", "Beluga", "BeamWeights", "FieldWeights", "Nav2Options", "Peer", "from_nav2"]
