"""Building blocks shared by the reconstructors: attention, blocks, dense and camera heads, the alternating trunk."""
