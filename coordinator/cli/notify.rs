//! Tells the service manager how a service is: the `sd_notify` protocol, which is one
//! datagram of `KEY=value` lines to the socket that `NOTIFY_SOCKET` names.
//!
//! Nothing happens where that variable is not set, which is everywhere but under systemd
//! and what imitates it. What cannot be sent is warned about and ends nothing.

/// The service works: its socket listens or its threads stand, and SIGTERM is awaited.
pub fn ready(status: &str) {
    send(&format!("READY=1\nSTATUS={}", one_line(status)));
}

/// The service was told to stop and is finishing what it has begun.
pub fn stopping() {
    send("STOPPING=1\nSTATUS=finishing what has begun");
}

/// A status is one line of the datagram, whatever a name in it holds.
fn one_line(status: &str) -> String {
    status.replace(|c: char| c.is_control(), " ")
}

#[cfg(unix)]
fn send(message: &str) {
    let Some(socket) = std::env::var_os("NOTIFY_SOCKET").filter(|name| !name.is_empty()) else {
        return;
    };
    if let Err(error) = datagram(&socket, message.as_bytes()) {
        let socket = socket.display();
        tracing::warn!(%socket, %error, "the service manager cannot be told");
    }
}

#[cfg(not(unix))]
fn send(_message: &str) {}

/// Sends to a path, or on Linux to `@name`, a socket that is in no file system.
#[cfg(unix)]
fn datagram(socket: &std::ffi::OsStr, message: &[u8]) -> std::io::Result<()> {
    use std::os::unix::ffi::OsStrExt;
    use std::os::unix::net::{SocketAddr, UnixDatagram};
    /// A service manager that does not read for so long is not waited for.
    const PATIENCE: std::time::Duration = std::time::Duration::from_secs(2);

    let address = match socket.as_bytes().split_first() {
        Some((b'/', _)) => SocketAddr::from_pathname(socket)?,
        #[cfg(target_os = "linux")]
        Some((b'@', name)) => {
            use std::os::linux::net::SocketAddrExt;
            SocketAddr::from_abstract_name(name)?
        }
        _ => {
            let why = "NOTIFY_SOCKET is neither a path nor @name";
            return Err(std::io::Error::new(std::io::ErrorKind::Unsupported, why));
        }
    };
    let sender = UnixDatagram::unbound()?;
    sender.set_write_timeout(Some(PATIENCE))?;
    sender.send_to_addr(message, &address)?;
    Ok(())
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::os::unix::net::UnixDatagram;

    fn received(socket: &UnixDatagram) -> String {
        let mut buffer = [0; 256];
        let length = socket.recv(&mut buffer).expect("a datagram waits");
        String::from_utf8(buffer[..length].to_vec()).expect("it is text")
    }

    #[test]
    fn a_datagram_reaches_a_socket_that_is_a_path() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("notify");
        let socket = UnixDatagram::bind(&path).expect("a socket");
        datagram(path.as_os_str(), b"READY=1").expect("sent");
        assert_eq!(received(&socket), "READY=1");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_datagram_reaches_a_socket_without_a_file() {
        use std::os::linux::net::SocketAddrExt;
        let name = format!("terrafarm-notify-{}", std::process::id());
        let address = std::os::unix::net::SocketAddr::from_abstract_name(&name).expect("a name");
        let socket = UnixDatagram::bind_addr(&address).expect("a socket");
        datagram(format!("@{name}").as_ref(), b"STOPPING=1").expect("sent");
        assert_eq!(received(&socket), "STOPPING=1");
    }

    #[test]
    fn a_socket_that_is_not_there_or_not_understood_is_an_error() {
        for name in ["/nowhere/at/all", "vsock:2:1234", "relative"] {
            assert!(datagram(name.as_ref(), b"READY=1").is_err(), "{name}");
        }
    }

    #[test]
    fn a_status_stays_one_line() {
        assert_eq!(one_line("a\nMAINPID=1\r"), "a MAINPID=1 ");
    }
}
