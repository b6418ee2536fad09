"""Body models with a skinned mesh."""
