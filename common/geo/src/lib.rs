//! Coordinate reference systems: positions between longitude/latitude and a store's
//! metric grid.
