//! Finding the coordinator on the local network, by multicast DNS (RFC 6762, 6763).
//!
//! What the network says is a hint, not a promise: anyone can announce anything. A link to
//! another PC is opened only with the farm token, which an impostor has not.

mod dns;

use crate::{args, notify};
use anyhow::Context;
use mdns_sd::{RecvTimeoutError, ScopedIp, ServiceDaemon, ServiceEvent, ServiceInfo};
use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::{Duration, Instant};
use terrafarm_worker::search::{Announced, News, Search};
use tokio::net::UdpSocket;
use tokio::sync::mpsc;

/// What a coordinator is announced as.
const SERVICE: &str = "_terrafarm._tcp.local.";
/// Where questions go: RFC 6762, section 3.
const MULTICAST: (Ipv4Addr, u16) = (Ipv4Addr::new(224, 0, 0, 251), 5353);
/// When a search asks, milliseconds from its start. Packets get lost, on Wi-Fi above all.
const ASKED_AT_MS: [u64; 6] = [0, 20, 80, 250, 1000, 2000];
/// Most networks of this PC that are asked: some have one for each container.
const NETWORKS_MAX: usize = 32;
/// Most addresses of one service that are looked at.
const ADDRESSES_MAX: usize = 4;
/// Most announcements that wait to be looked at.
const HEARD_MAX: usize = 256;
/// How often it is looked whether anybody still listens.
const LOOK_UP: Duration = Duration::from_millis(100);
/// How long a farewell may take.
const FAREWELL: Duration = Duration::from_millis(300);

/// An announcement; it ends with this value.
pub struct Announcement {
    daemon: ServiceDaemon,
    name: String,
}

impl Announcement {
    /// Tells the local network that a coordinator listens on an address of this PC.
    ///
    /// # Errors
    /// If the system gives no socket for it, or the name is unfit.
    pub fn begin(address: SocketAddr, pc: &str) -> anyhow::Result<Self> {
        let daemon = ServiceDaemon::new().context("cannot open a multicast socket")?;
        // Names of hosts and instances are labels of at most 63 bytes.
        let label: String = pc.chars().filter(|c| c.is_ascii_alphanumeric() || *c == '-').collect();
        let label = if label.is_empty() { "coordinator" } else { &label[..label.len().min(48)] };
        let instance = format!("{label}-{}", address.port());
        let host = format!("{label}.local.");
        let ip = address.ip();
        let info = if ip.is_unspecified() {
            ServiceInfo::new(SERVICE, &instance, &host, (), address.port(), None)
                .map(ServiceInfo::enable_addr_auto)
        } else {
            ServiceInfo::new(SERVICE, &instance, &host, ip, address.port(), None)
        };
        let info = info.context("cannot describe this coordinator")?;
        let name = info.get_fullname().to_owned();
        daemon.register(info).context("cannot announce this coordinator")?;
        Ok(Announcement { daemon, name })
    }
}

impl Drop for Announcement {
    fn drop(&mut self) {
        // Workers that look later need not try an address where nobody is.
        if let Ok(done) = self.daemon.unregister(&self.name) {
            let _ = done.recv_timeout(FAREWELL);
        }
        let _ = self.daemon.shutdown();
    }
}

/// The local network, where coordinators are looked for.
///
/// It is asked in two ways at once. A question from a port of its own is answered to that port
/// alone, at once, and however often it is asked (RFC 6762, section 6.7). What is multicast is
/// heard, too: it comes through firewalls that stop the other, but at most once a second.
#[derive(Debug)]
pub struct Lan;

impl Search for Lan {
    fn here(&self) -> SocketAddr {
        args::COORDINATOR.parse().expect("the usual address is one")
    }

    fn begin(&self) -> mpsc::Receiver<Announced> {
        let (sender, receiver) = mpsc::channel(HEARD_MAX);
        let listener = sender.clone();
        tokio::task::spawn_blocking(move || {
            if let Err(why) = listen(&listener) {
                tracing::debug!("cannot listen to what is multicast: {why:#}");
            }
        });
        for ip in own_addresses() {
            let sender = sender.clone();
            tokio::spawn(async move {
                tokio::select! {
                    Err(why) = ask(ip, &sender) => {
                        tracing::debug!(%ip, "cannot ask this network: {why}");
                    }
                    () = sender.closed() => {}
                }
            });
        }
        receiver
    }

    fn tell(&self, news: &News) {
        match news {
            News::Waiting(why) => {
                why.iter().for_each(|why| eprintln!("terrafarm: {why}"));
                print_line!("waiting for a coordinator; name one with --coordinator HOST:PORT");
                notify::ready("looking for a coordinator");
            }
            News::Found { place, others } => {
                match others.is_empty() {
                    true => print_line!("found a coordinator at {place}"),
                    false => eprintln!(
                        "terrafarm: warning: found a coordinator at {place}, the lowest name of \
                         several with this token; --coordinator HOST:PORT chooses another: {}",
                        others.join(", ")
                    ),
                }
                notify::ready(&format!("working for {place}"));
            }
        }
    }
}

/// Hands on what is multicast, until nobody listens.
fn listen(sender: &mpsc::Sender<Announced>) -> anyhow::Result<()> {
    let daemon = ServiceDaemon::new().context("cannot open a multicast socket")?;
    let found = daemon.browse(SERVICE).context("cannot look for a coordinator")?;
    while !sender.is_closed() {
        match found.recv_timeout(LOOK_UP) {
            Ok(ServiceEvent::ServiceResolved(service)) => {
                let name = service.get_fullname().trim_end_matches(SERVICE).trim_end_matches('.');
                let mut addresses: Vec<_> = service.get_addresses().iter().map(socket_ip).collect();
                addresses.sort();
                for (ip, scope) in addresses.into_iter().take(ADDRESSES_MAX) {
                    let mut address = SocketAddr::new(ip, service.get_port());
                    if let SocketAddr::V6(address) = &mut address {
                        address.set_scope_id(scope);
                    }
                    hand_on(sender, Announced { name: dns::shown(name.as_bytes()), address });
                }
            }
            Ok(_) | Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
    }
    let _ = daemon.shutdown();
    Ok(())
}

/// An address, and the network that it is meant for.
fn socket_ip(scoped: &ScopedIp) -> (IpAddr, u32) {
    let scope = match scoped {
        ScopedIp::V6(v6) if v6.addr().is_unicast_link_local() => v6.scope_id().index,
        _ => 0,
    };
    (scoped.to_ip_addr(), scope)
}

/// Asks one network, again and again, and hands on what is answered.
async fn ask(ip: Ipv4Addr, sender: &mpsc::Sender<Announced>) -> io::Result<()> {
    let socket = UdpSocket::bind((ip, 0)).await?;
    // Where the route for multicast leads is not where this network is.
    socket2::SockRef::from(&socket).set_multicast_if_v4(&ip)?;
    socket2::SockRef::from(&socket).set_multicast_ttl_v4(255)?;
    let port = socket.local_addr()?.port();
    let question = dns::question(port, SERVICE);
    let begun = Instant::now();
    let mut times = ASKED_AT_MS.iter().map(|&ms| begun + Duration::from_millis(ms));
    let mut next = times.next();
    let mut packet = vec![0; dns::PACKET_MAX];
    loop {
        let received = match next {
            Some(at) => tokio::time::timeout_at(at.into(), socket.recv_from(&mut packet)).await,
            None => Ok(socket.recv_from(&mut packet).await),
        };
        match received {
            Ok(received) => {
                // A port where nobody listens may be told to this one.
                let Ok((length, _)) = received else { continue };
                for service in dns::answers(&packet[..length], SERVICE) {
                    for ip in service.addresses {
                        let address = SocketAddr::new(ip, service.port);
                        hand_on(sender, Announced { name: service.name.clone(), address });
                    }
                }
            }
            Err(_) => {
                socket.send_to(&question, MULTICAST).await?;
                next = times.next();
            }
        }
    }
}

/// Hands on what leads somewhere. A network that says more than can be heard is not heard out.
fn hand_on(sender: &mpsc::Sender<Announced>, announced: Announced) {
    if leads_somewhere(announced.address) {
        let _unheard = sender.try_send(announced);
    }
}

/// Whether a coordinator can be at an address that is announced: another PC's loopback is
/// not ours.
fn leads_somewhere(address: SocketAddr) -> bool {
    let ip = address.ip().to_canonical();
    let is_broadcast = matches!(ip, IpAddr::V4(ip) if ip.is_broadcast());
    let is_nowhere = ip.is_loopback() || ip.is_multicast() || ip.is_unspecified() || is_broadcast;
    address.port() != 0 && !is_nowhere
}

/// Addresses of this PC, one for each network that it is in.
fn own_addresses() -> Vec<Ipv4Addr> {
    let all = if_addrs::get_if_addrs().unwrap_or_default();
    let own: BTreeSet<_> = all
        .iter()
        .filter_map(|network| match network.ip() {
            IpAddr::V4(ip) if !ip.is_loopback() => Some(ip),
            _ => None,
        })
        .collect();
    own.into_iter().take(NETWORKS_MAX).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn announcements_that_lead_nowhere_are_not_handed_on() {
        let of = |text: &str| leads_somewhere(text.parse().expect("an address"));
        let nowhere = [
            "127.0.0.1:7070",
            "[::1]:7070",
            "[::ffff:127.0.0.1]:7070",
            "0.0.0.0:7070",
            "255.255.255.255:7070",
            "224.0.0.251:5353",
            "10.0.0.1:0",
        ];
        assert_eq!(nowhere.map(of), [false; 7]);
        assert_eq!(["10.0.0.1:7070", "[fe80::1]:7070"].map(of), [true; 2]);
    }
}
