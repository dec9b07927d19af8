//! What the system tells of processes: CPU time.

/// CPU time that this process has had, all threads, seconds; where the system tells.
#[cfg(unix)]
pub fn own_cpu_s() -> Option<f64> {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Some(time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9)
}

/// As above, where it does not tell.
#[cfg(not(unix))]
pub fn own_cpu_s() -> Option<f64> {
    None
}

/// CPU time that another process has had, all threads, seconds; on Linux.
#[cfg(target_os = "linux")]
pub fn cpu_s_of(process: u32) -> Option<f64> {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    Some(ticks(&stat)? as f64 / rustix::param::clock_ticks_per_second() as f64)
}

/// As above, elsewhere.
#[cfg(not(target_os = "linux"))]
pub fn cpu_s_of(_process: u32) -> Option<f64> {
    None
}

/// CPU time that everything on this PC has had, all cores together, seconds; on Linux.
#[cfg(target_os = "linux")]
pub fn all_cpu_s() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/stat").ok()?;
    let ticks = stat.lines().next()?.strip_prefix("cpu ")?.split_ascii_whitespace();
    let ticks: Vec<u64> = ticks.map_while(|field| field.parse().ok()).collect();
    // user, nice, system, idle, waiting for a disk, two of interrupts.
    let [user, nice, system, _, _, hard, soft, ..] = ticks[..] else { return None };
    let busy = [user, nice, system, hard, soft].into_iter().fold(0u64, u64::saturating_add);
    Some(busy as f64 / rustix::param::clock_ticks_per_second() as f64)
}

/// As above, elsewhere.
#[cfg(not(target_os = "linux"))]
pub fn all_cpu_s() -> Option<f64> {
    None
}

/// Ticks in user and in kernel mode of a `stat` line. The name before them may hold
/// anything, blanks and brackets included; the last bracket ends it.
#[cfg(target_os = "linux")]
fn ticks(stat: &str) -> Option<u64> {
    let (_, fields) = stat.rsplit_once(')')?;
    let mut fields = fields.split_ascii_whitespace().skip(11);
    let user: u64 = fields.next()?.parse().ok()?;
    let kernel: u64 = fields.next()?.parse().ok()?;
    user.checked_add(kernel)
}

#[cfg(test)]
mod tests {
    #[cfg(target_os = "linux")]
    #[test]
    fn ticks_are_found_behind_any_name() {
        let stat = "42 (a) b (c) S 1 2 3 4 5 6 7 8 9 10 70 5 0 0 20 0";
        assert_eq!(super::ticks(stat), Some(75));
        assert_eq!(super::ticks("42"), None);
        let own = super::cpu_s_of(std::process::id()).expect("the system tells of us");
        assert!(own >= 0.0);
    }
}
