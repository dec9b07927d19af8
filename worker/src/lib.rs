//! The worker: session, link, render pool, blob cache.
