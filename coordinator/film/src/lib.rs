//! Tiles to pictures: merging, and the files pictures go to.
