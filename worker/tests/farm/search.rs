//! A worker that was told no address: what it makes of what the network says.

use crate::script::{Coordinator, PATIENCE, Running, start};
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};
use terrafarm_wire::link::{FarmToken, Trust, accept, prove};
use terrafarm_wire::message::{Goodbye, Refusal};
use terrafarm_worker::search::{Announced, News, Search};
use terrafarm_worker::{Reconnect, Whereabouts, WorkerConfig};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;

const OURS: FarmToken = FarmToken::from_bytes([1; 32]);
const THEIRS: FarmToken = FarmToken::from_bytes([2; 32]);

/// A network that says what it is made to say.
#[derive(Debug)]
struct Network {
    here: SocketAddr,
    says: Mutex<Vec<Announced>>,
    told: mpsc::UnboundedSender<News>,
}

impl Search for Network {
    fn here(&self) -> SocketAddr {
        self.here
    }

    fn begin(&self) -> mpsc::Receiver<Announced> {
        let says = self.says.lock().unwrap().clone();
        let (sender, receiver) = mpsc::channel(says.len() + 1);
        says.into_iter().for_each(|announced| sender.try_send(announced).unwrap());
        receiver
    }

    fn tell(&self, news: &News) {
        self.told.send(news.clone()).unwrap();
    }
}

/// An address of this PC at which nobody listens.
async fn nowhere() -> SocketAddr {
    TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap()
}

fn announced(name: &str, address: SocketAddr) -> Announced {
    Announced { name: name.to_owned(), address }
}

/// A worker with our token on a network that says this, and what people are told.
async fn worker(says: Vec<Announced>) -> (Running, Arc<Network>, mpsc::UnboundedReceiver<News>) {
    let config = Coordinator::new().await.config(None);
    let (told, news) = mpsc::unbounded_channel();
    let network = Arc::new(Network { here: nowhere().await, says: Mutex::new(says), told });
    let config = WorkerConfig {
        coordinator: Whereabouts::Sought(network.clone()),
        trust: Trust::Token(OURS),
        reconnect: Reconnect { attempts: None, ..config.reconnect },
        ..config
    };
    (start(config), network, news)
}

impl Coordinator {
    fn at(&self, name: &str) -> Announced {
        announced(name, self.listener.local_addr().unwrap())
    }

    /// Lets in whoever proves a token, for ever; peers are kept open and not greeted.
    fn prove_only(self, token: FarmToken) {
        tokio::spawn(async move {
            loop {
                let (stream, _) = self.listener.accept().await.unwrap();
                let _unproven = accept(stream, Some(&token), "terrafarm test", PATIENCE).await;
            }
        });
    }
}

async fn next(news: &mut mpsc::UnboundedReceiver<News>) -> News {
    tokio::time::timeout(PATIENCE, news.recv()).await.expect("people are told").unwrap()
}

#[tokio::test]
async fn the_coordinator_that_proves_the_token_is_ours_whoever_else_is_announced() {
    let (ours, theirs) = (Coordinator::new().await, Coordinator::new().await);
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let says = vec![
        announced("a-stale", nowhere().await),
        announced("b-silent", silent.local_addr().unwrap()),
        theirs.at("c-theirs"),
        ours.at("d-ours"),
    ];
    theirs.prove_only(THEIRS);
    let (_running, _network, mut news) = worker(says).await;
    let begun = Instant::now();
    let peer = ours.welcome_by(Some(&OURS)).await;
    assert_eq!(peer.hello.name, "pc-1");
    assert!(begun.elapsed() < Duration::from_secs(3), "silence is not waited for");
    let place = format!("{} (d-ours)", ours.listener.local_addr().unwrap());
    assert_eq!(next(&mut news).await, News::Found { place, others: Vec::new() });
}

#[tokio::test]
async fn of_several_that_prove_the_token_the_lowest_name_is_taken_and_the_others_are_told() {
    let (first, second) = (Coordinator::new().await, Coordinator::new().await);
    let says = vec![second.at("b"), first.at("a")];
    let other = format!("{} (b)", second.listener.local_addr().unwrap());
    second.prove_only(OURS);
    let (_running, _network, mut news) = worker(says).await;
    first.welcome_by(Some(&OURS)).await;
    let place = format!("{} (a)", first.listener.local_addr().unwrap());
    assert_eq!(next(&mut news).await, News::Found { place, others: vec![other] });
}

#[tokio::test]
async fn a_coordinator_is_found_behind_hundreds_of_false_announcements() {
    // Each accepts and says nothing; where 127.0.0.2 is no address of this PC, nobody does.
    let silent = TcpListener::bind("0.0.0.0:0").await.unwrap();
    let port = silent.local_addr().unwrap().port();
    let false_one = |n: u16| {
        let [high, low] = n.to_be_bytes();
        announced("a\u{1b}[2J\n", SocketAddr::from(([127, 1, high, low], port)))
    };
    let ours = Coordinator::new().await;
    let mut says: Vec<_> = (1..=700).map(false_one).collect();
    says.insert(350, ours.at("tower"));
    let (_running, _network, _news) = worker(says).await;
    let begun = Instant::now();
    ours.welcome_by(Some(&OURS)).await;
    assert!(begun.elapsed() < Duration::from_secs(3), "{:?}", begun.elapsed());
}

#[tokio::test]
async fn a_coordinator_that_has_moved_is_found_at_its_new_address() {
    let before = Coordinator::new().await;
    let (_running, network, mut news) = worker(vec![before.at("tower")]).await;
    let peer = before.welcome_by(Some(&OURS)).await;
    assert!(matches!(next(&mut news).await, News::Found { .. }));
    let after = Coordinator::new().await;
    *network.says.lock().unwrap() = vec![after.at("attic")];
    drop((before, peer));
    after.welcome_by(Some(&OURS)).await;
    let place = format!("{} (attic)", after.listener.local_addr().unwrap());
    assert_eq!(next(&mut news).await, News::Found { place, others: Vec::new() });
}

#[tokio::test]
async fn a_coordinator_that_comes_back_where_it_was_needs_no_announcement() {
    let ours = Coordinator::new().await;
    let (_running, network, mut news) = worker(vec![ours.at("tower")]).await;
    let mut peer = ours.welcome_by(Some(&OURS)).await;
    assert!(matches!(next(&mut news).await, News::Found { .. }));
    network.says.lock().unwrap().clear();
    peer.send(Goodbye { reason: "restarting".to_owned() }).await;
    drop(peer);
    ours.welcome_by(Some(&OURS)).await;
    let place = ours.listener.local_addr().unwrap().to_string();
    assert_eq!(next(&mut news).await, News::Found { place, others: Vec::new() });
}

#[tokio::test]
async fn a_search_goes_on_after_coordinators_that_refuse_and_says_why() {
    let (theirs, ours) = (Coordinator::new().await, Coordinator::new().await);
    let says = vec![theirs.at("theirs")];
    theirs.prove_only(THEIRS);
    let (_running, network, mut news) = worker(says).await;
    let News::Waiting(why) = next(&mut news).await else { panic!("nobody has let it in") };
    assert!(
        why.len() == 1 && why[0].contains("(theirs): the coordinator does not accept"),
        "{why:?}"
    );
    network.says.lock().unwrap().push(ours.at("ours"));
    // The first one that proves the token refuses the worker for good, as it may be too old.
    let (stream, _) = ours.listener.accept().await.unwrap();
    let greeting = accept(stream, Some(&OURS), "terrafarm test", PATIENCE).await.unwrap();
    greeting.refuse(Refusal::Version, "upgrade the worker").await;
    ours.welcome_by(Some(&OURS)).await;
}

#[tokio::test]
async fn one_of_this_pc_goes_before_all_others() {
    let (here, there) = (Coordinator::new().await, Coordinator::new().await);
    let config = here.config(None);
    let (told, mut news) = mpsc::unbounded_channel();
    let says = Mutex::new(vec![there.at("a")]);
    let network = Arc::new(Network { here: here.listener.local_addr().unwrap(), says, told });
    there.prove_only(OURS);
    let coordinator = Whereabouts::Sought(network);
    let _running = start(WorkerConfig { coordinator, trust: Trust::Token(OURS), ..config });
    here.welcome_by(Some(&OURS)).await;
    let place = here.listener.local_addr().unwrap().to_string();
    assert_eq!(next(&mut news).await, News::Found { place, others: Vec::new() });
}

#[tokio::test]
async fn a_worker_that_shall_not_wait_ends_with_what_it_has_found() {
    let config = Coordinator::new().await.config(None);
    let (told, _news) = mpsc::unbounded_channel();
    let network = Arc::new(Network { here: nowhere().await, says: Mutex::default(), told });
    let coordinator = Whereabouts::Sought(network);
    let config = WorkerConfig { coordinator, reconnect: Reconnect::NEVER, ..config };
    let error = start(config).ended.await.unwrap().unwrap_err().to_string();
    assert!(error.starts_with("no coordinator on this PC, and none answers"), "{error}");
    assert!(error.ends_with("--coordinator HOST:PORT"), "{error}");
}

#[tokio::test]
async fn a_proof_alone_is_no_greeting() {
    let coordinator = Coordinator::new().await;
    let address = coordinator.listener.local_addr().unwrap();
    let connecting = async {
        let stream = TcpStream::connect(address).await.unwrap();
        prove(stream, Some(&OURS), PATIENCE).await.map(drop)
    };
    let accepting = async {
        let (stream, _) = coordinator.listener.accept().await.unwrap();
        accept(stream, Some(&OURS), "terrafarm test", PATIENCE).await.map(drop)
    };
    let (proved, greeted) = tokio::join!(connecting, accepting);
    assert!(proved.is_ok());
    assert!(greeted.is_err(), "a stranger has left");
}
