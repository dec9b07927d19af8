//! The greeting of a secure link as a coordinator hears it: from a stranger who may send
//! anything, and from a worker with the token whose bytes are changed on their way. First
//! byte: who; then what is sent, or what the bytes of the worker are changed by.

#![no_main]

use std::time::Duration;
use terrafarm_wire::link::{FarmToken, accept, greet};
use terrafarm_wire::message::{Hello, Role};
use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};

/// First byte of an input that changes what a worker sends.
const MEDDLE: u8 = 1;
const LIMIT: Duration = Duration::from_secs(5);
/// Longer than all that a worker sends, bytes.
const PIPE: usize = 64 << 10;

terrafarm_fuzz::target!(seeds(), accepts);

/// Only what changes nothing is accepted.
fn seeds() -> Vec<Vec<u8>> {
    vec![vec![MEDDLE], [&[MEDDLE][..], &[0; 120]].concat()]
}

fn accepts(input: &[u8]) -> bool {
    let Some((&first, bytes)) = input.split_first() else { return false };
    // Time passes at once where both sides wait for each other.
    let mut runtime = tokio::runtime::Builder::new_current_thread();
    let runtime = runtime.enable_time().start_paused(true).build();
    runtime.expect("a runtime").block_on(async {
        if first & MEDDLE == 0 {
            assert!(!is_let_in(bytes).await, "a stranger has got in");
            return false;
        }
        let (let_in, length) = is_let_in_through(bytes).await;
        let touched = bytes.iter().take(length).any(|bits| *bits != 0);
        assert_eq!(let_in, !touched, "{length} bytes sent");
        let_in
    })
}

fn token() -> FarmToken {
    FarmToken::from_bytes([7; 32])
}

async fn is_let_in(bytes: &[u8]) -> bool {
    let (mut near, far) = duplex(PIPE);
    near.write_all(bytes).await.expect("the pipe is long enough");
    near.shutdown().await.expect("the pipe is open");
    accept(far, Some(&token()), "terrafarm fuzz", LIMIT).await.is_ok()
}

/// Whether a worker is let in whose bytes are changed by these bits, and how many it sent.
async fn is_let_in_through(bits: &[u8]) -> (bool, usize) {
    let ((near, near_side), (far_side, far)) = (duplex(PIPE), duplex(PIPE));
    let token = token();
    let worker = async {
        let role = Role::Worker { threads: 1, incarnation: 1, identity: 1 };
        drop(greet(near, Some(&token), Hello::new("fuzz", role), LIMIT).await);
    };
    let coordinator = async { accept(far, Some(&token), "terrafarm fuzz", LIMIT).await.is_ok() };
    let ((mut near_read, mut near_write), (mut far_read, mut far_write)) =
        (tokio::io::split(near_side), tokio::io::split(far_side));
    let there = async {
        let (mut sent, mut buffer) = (0, vec![0; PIPE]);
        while let Ok(length @ 1..) = near_read.read(&mut buffer).await {
            for (byte, bits) in buffer[..length].iter_mut().zip(bits.iter().skip(sent)) {
                *byte ^= bits;
            }
            sent += length;
            if far_write.write_all(&buffer[..length]).await.is_err() {
                break;
            }
        }
        let _ = far_write.shutdown().await;
        sent
    };
    let back = async {
        let _ = tokio::io::copy(&mut far_read, &mut near_write).await;
        let _ = near_write.shutdown().await;
    };
    let ((), let_in, sent, ()) = tokio::join!(worker, coordinator, there, back);
    (let_in, sent)
}
