//! The JSON of a submission. What is read can be written again and reads the same; what a
//! farm takes has only sound cameras of its own size.

#![no_main]

use terrafarm_coordinator::queue::ShotPlan;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    vec![terrafarm_fuzz::seeds::submission().into_bytes()]
}

fn accepts(input: &[u8]) -> bool {
    let Ok(plan) = serde_json::from_slice::<ShotPlan>(input) else { return false };
    let text = serde_json::to_vec(&plan).expect("what was read may be written");
    let again = serde_json::from_slice::<ShotPlan>(&text).expect("what was written may be read");
    assert_eq!(again, plan);
    if plan.check().is_err() {
        return false;
    }
    let [width, height] = plan.size;
    for camera in &plan.cameras {
        assert!(camera.is_valid() && (camera.width, camera.height) == (width, height));
    }
    true
}
