//! Values of the queue's records, as a coordinator reads them that starts. First byte:
//! a frame, or a shot with its row of progress and a piece of its cameras.

#![no_main]

use terrafarm_coordinator::fuzz::{is_frame_on_record, is_shot_on_record};

const FRAME: u8 = 0;
const SHOT: u8 = 1;
/// Three numbers of the row of progress, and the length of the shot's record.
const HEAD: usize = 3 * 4 + 2;

terrafarm_fuzz::target!(seeds(), accepts);

fn seeds() -> Vec<Vec<u8>> {
    let plan = terrafarm_fuzz::seeds::submission();
    let record = format!(
        r#"{{"plan":{plan},"frames":1,"submitted_s":1,"stage":"open","note":"","workers":[]}}"#
    );
    let mut shot = vec![SHOT];
    [1u32, 0, 1].into_iter().for_each(|number| shot.extend(number.to_le_bytes()));
    shot.extend((record.len() as u16).to_le_bytes());
    shot.extend(record.as_bytes());
    [0.0, 0.0, 9.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0f64]
        .into_iter()
        .for_each(|number| shot.extend(number.to_le_bytes()));
    vec![[&[FRAME][..], br#"{"failed":"no terrain"}"#].concat(), shot]
}

fn accepts(input: &[u8]) -> bool {
    match input.split_first() {
        Some((&FRAME, record)) => is_frame_on_record(record),
        Some((_, shot)) => is_shot(shot),
        None => false,
    }
}

fn is_shot(input: &[u8]) -> bool {
    let Some((head, rest)) = input.split_first_chunk::<HEAD>() else { return false };
    let number =
        |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
    let length = usize::from(u16::from_le_bytes([head[12], head[13]])).min(rest.len());
    let (record, cameras) = rest.split_at(length);
    is_shot_on_record(record, (number(0), number(4), number(8)), cameras)
}
