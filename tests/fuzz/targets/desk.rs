//! Requests of a desk: any verb, path, range and body, to the coordinator's API. First byte:
//! verb, and whether a range follows; then the path up to the end of its line, then the
//! body. There is always an answer, and what says that it is JSON is.

#![no_main]

use bytes::Bytes;
use terrafarm_coordinator::fuzz::Api;
use terrafarm_wire::message::{Request, Verb};

const VERBS: [Verb; 3] = [Verb::Get, Verb::Post, Verb::Put];
const RANGE: u8 = 4;

terrafarm_fuzz::target!(seeds(), accepts);

/// Those that a coordinator answers that has neither a queue nor a farm.
fn seeds() -> Vec<Vec<u8>> {
    let answered: [&[u8]; 7] = [
        b"/api/v1/farm",
        b"/api/v1/workers",
        b"/api/v1/shots",
        b"/api/v1/shots?state=done&offset=1&limit=20",
        b"/metrics",
        b"/healthz",
        b"/api/v1/farm\n{}",
    ];
    let mut seeds: Vec<_> = answered.map(|path| [&[0], path].concat()).to_vec();
    seeds.push([&[RANGE][..], &[0; 8], &[1; 8], b"/metrics"].concat());
    seeds
}

fn accepts(input: &[u8]) -> bool {
    let Some((&first, mut rest)) = input.split_first() else { return false };
    let range = if first & RANGE == 0 {
        None
    } else {
        let Some((begin, after)) = rest.split_first_chunk() else { return false };
        let Some((length, after)) = after.split_first_chunk() else { return false };
        rest = after;
        // The wire lets no empty range in.
        Some((u64::from_le_bytes(*begin), u64::from_le_bytes(*length).max(1)))
    };
    let line = rest.iter().position(|&byte| byte == b'\n').unwrap_or(rest.len());
    let (path, body) = (&rest[..line], rest.get(line + 1..).unwrap_or_default());
    let Ok(path) = std::str::from_utf8(path) else { return false };
    if !path.starts_with('/') {
        return false;
    }
    let verb = VERBS[usize::from(first & 3) % VERBS.len()];
    let body = Bytes::copy_from_slice(body);
    let request = Request { number: 7, verb, path: path.to_owned(), range, body };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
    let answer =
        runtime.expect("a runtime").block_on(async { Api::default().answer(request).await });
    assert_eq!(answer.number, 7);
    assert!((200..600).contains(&answer.status), "{}", answer.status);
    if answer.content_type.starts_with("application/json") && answer.status != 206 {
        let json = serde_json::from_slice::<serde_json::Value>(&answer.body);
        assert!(json.is_ok(), "{json:?}");
    }
    answer.status < 300
}
