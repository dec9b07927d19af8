//! The ray-casting core: resident tiles, camera, region and quality to a film tile.
