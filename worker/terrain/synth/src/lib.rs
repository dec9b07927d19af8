//! Procedural terrain: eroded mountains with a plausible aerial photo, from a seed.
