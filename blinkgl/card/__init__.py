"""Events made on the card: the emulators' kernels as compute shaders, the same events bit for bit.

In:    frames and the emulators' configurations (``blinkgl.events``), a context (``blinkgl.gl``).
Out:   an ``Emulator`` whose state lies on the card; tensors of events that stay there.
Start: emulator.py, esim.py, v2e.py; the kernels are shaders/compute/events_*.glsl and v2e_*.glsl. Batches: atlas.py;
for torch: tensors.py.
"""

from blinkgl.card.atlas import Atlas
from blinkgl.card.atlas_v2e import AtlasV2e
from blinkgl.card.esim import CardEsim
from blinkgl.card.sinks import Counts, Latest, Voxels
from blinkgl.card.tile_sinks import TileSinks
from blinkgl.card.v2e import CardV2e

__all__ = ["Atlas", "AtlasV2e", "CardEsim", "CardV2e", "Counts", "Latest", "TileSinks", "Voxels"]
