//! Megabytes a second over loopback, plain and secure: blobs as large as tiles and as
//! parts, one way, on a runtime of two threads as the services have. Medians of five.

use std::time::{Duration, Instant};
use terrafarm_common::id::BlobHash;
use terrafarm_wire::Message;
use terrafarm_wire::link::{FarmToken, accept, greet};
use terrafarm_wire::message::{Blob, Hello, Role};
use tokio::net::{TcpListener, TcpStream};

const TOTAL_BYTES: usize = 1 << 30;
const LIMIT: Duration = Duration::from_secs(60);

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let token = FarmToken::generate()?;
    for length in [4 << 10, 300 << 10, 6 << 20] {
        for (name, token) in [("plain", None), ("secure", Some(&token))] {
            let mut speeds = Vec::new();
            for _ in 0..5 {
                let took = runtime.block_on(send(token.cloned(), length))?;
                speeds.push(TOTAL_BYTES as f64 / 1e6 / took.as_secs_f64());
            }
            speeds.sort_by(f64::total_cmp);
            println!("{name:6} {:5} KiB a message: {:6.0} MB/s", length >> 10, speeds[2]);
        }
    }
    Ok(())
}

/// Sends blobs of one length and waits until all have been read.
async fn send(
    token: Option<FarmToken>,
    length: usize,
) -> Result<Duration, Box<dyn std::error::Error>> {
    let listener = TcpListener::bind("127.0.0.1:0").await?;
    let address = listener.local_addr()?;
    let theirs = token.clone();
    let reading = tokio::spawn(async move {
        let (stream, _) = listener.accept().await.expect("a connection");
        let greeting = accept(stream, theirs.as_ref(), "bench", LIMIT).await.expect("a greeting");
        let (beat, silence) = (LIMIT, 2 * LIMIT);
        let welcomed = greeting.welcome(1, "bench", beat, silence).await;
        let (mut connection, _) = welcomed.expect("an open link");
        let mut bytes = 0;
        while let Ok(Some(Message::Blob(blob))) = connection.recv().await {
            bytes += blob.bytes.len();
        }
        bytes
    });
    let stream = TcpStream::connect(address).await?;
    let hello = Hello::new("bench", Role::Client);
    let (mut connection, _) = greet(stream, token.as_ref(), hello, LIMIT).await?;
    let blob: Message = Blob { hash: BlobHash([1; 32]), bytes: vec![7; length].into() }.into();
    let count = TOTAL_BYTES / length;
    let began = Instant::now();
    for _ in 0..count {
        connection.send(&blob).await?;
    }
    drop(connection);
    assert_eq!(reading.await?, count * length);
    Ok(began.elapsed())
}
