//! The index of a store as a worker receives it. Whatever passes can be used.

#![no_main]

use std::sync::Arc;
use terrafarm_terrain::layout::{LayerKind, StoreIndex};
use terrafarm_terrain::resident::Resident;
use terrafarm_terrain::store::decode_index;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let index = |store: Vec<u8>| {
        let offset = u64::from_le_bytes(*store[16..].first_chunk().expect("a header"));
        store[offset as usize..].to_vec()
    };
    terrafarm_fuzz::stores::small().into_iter().map(index).collect()
}

fn accepts(input: &[u8]) -> bool {
    let Ok(index) = decode_index(input) else { return false };
    let bytes = postcard::to_stdvec(&index).expect("an index can be written");
    let again: StoreIndex = decode_index(&bytes).expect("what was read may be written");
    assert_eq!(again, index);
    for layer in &index.layers {
        assert!(layer.far_corner().iter().all(|value| value.is_finite()));
        let top = layer.levels.last().expect("a layer has a level");
        assert_eq!(top.entries.len(), 1);
        for level in 0..layer.levels.len() {
            let [columns, rows] = layer.levels[level].tiles;
            assert!(layer.entry(level, columns - 1, rows - 1).is_some());
            assert!(layer.level_spacing(level).iter().all(|step| *step > 0.0));
        }
    }
    assert!(index.layers_of(LayerKind::Height).next().is_some());
    assert_eq!(Resident::new(Arc::new(index)).bytes(), 0);
    true
}
