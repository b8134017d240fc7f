"""The weights that nav2_amcl and Beluga give a scan, and their parameters; see :mod:`gpusense.world.compat`.

:func:`from_nav2` reads the parameters of nav2_amcl's node, :mod:`gpusense.localization.nav2`.
"""

from gpusense.localization.nav2 import Nav2Options, from_nav2
from gpusense.world.compat import PEERS, Amcl, Beluga, Peer
from gpusense.world.peer_weights import BeamWeights, FieldWeights

__all__ = ["PEERS", "Amcl", "Beluga", "BeamWeights", "FieldWeights", "Nav2Options", "Peer", "from_nav2"]
