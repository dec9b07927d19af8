//! Finding the coordinator on the local network, by multicast DNS (RFC 6762, 6763).
//!
//! What the network says is a hint, not a promise: anyone can announce anything. A link to
//! another PC is opened only with the farm token, which an impostor has not.

use anyhow::{Context, bail};
use mdns_sd::{ResolvedService, ServiceDaemon, ServiceEvent, ServiceInfo};
use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

/// What a coordinator is announced as.
const SERVICE: &str = "_terrafarm._tcp.local.";
/// After the first answer, how long others are waited for.
const OTHERS: Duration = Duration::from_millis(300);

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
            let _ = done.recv_timeout(OTHERS);
        }
        let _ = self.daemon.shutdown();
    }
}

/// The coordinator of the local network; `None` if nobody answers within the patience.
///
/// # Errors
/// If there are several, or the system gives no socket.
pub fn find(patience: Duration) -> anyhow::Result<Option<SocketAddr>> {
    let daemon = ServiceDaemon::new().context("cannot open a multicast socket")?;
    let found = daemon.browse(SERVICE).context("cannot look for a coordinator")?;
    let mut until = Instant::now() + patience;
    let mut farms: BTreeSet<(String, SocketAddr)> = BTreeSet::new();
    while let Ok(event) = found.recv_deadline(until) {
        if let ServiceEvent::ServiceResolved(service) = event
            && let Some(address) = address_of(&service)
        {
            if farms.is_empty() {
                until = until.min(Instant::now() + OTHERS);
            }
            farms.insert((service.get_fullname().to_owned(), address));
        }
    }
    let _ = daemon.shutdown();
    let names: BTreeSet<_> = farms.iter().map(|(name, _)| name).collect();
    if names.len() > 1 {
        let all: Vec<_> = farms.iter().map(|(_, address)| address.to_string()).collect();
        bail!("several coordinators answer: {}; choose one with --coordinator", all.join(", "));
    }
    Ok(farms.first().map(|(_, address)| *address))
}

/// Where a service can be reached: by its IPv4 address if it has one, which office networks
/// route with fewer surprises.
fn address_of(service: &ResolvedService) -> Option<SocketAddr> {
    let addresses = service.get_addresses().iter().map(mdns_sd::ScopedIp::to_ip_addr);
    let ip = addresses.min_by_key(|ip: &IpAddr| (ip.is_ipv6(), *ip))?;
    Some(SocketAddr::new(ip, service.get_port()))
}
