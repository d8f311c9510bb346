"""Data: from shards of groups to the batches of a training, on the CPU or on its device."""
