//! Who may ask by HTTP.
//!
//! On this PC alone, whoever reaches the port may; but not the pages of strangers in the
//! browser of whoever sits here. A page that has its own name resolve to 127.0.0.1 sends
//! that name in `Host`: only addresses and this PC's names are taken. A page that posts
//! here from elsewhere sends another `Origin`, or says `cross-site`: it is refused.
//!
//! Where other PCs can reach the port, every request needs the key, as a bearer token or in
//! the cookie that the login page sets. The key is derived from the farm token and does not
//! reveal it. HTTP itself is not encrypted: that is for an SSH tunnel or a proxy with TLS.
//! Who has not shown it keeps no connection: strangers could else take all that there are.

use super::refusal::Refusal;
use super::{in_time, page};
use axum::Router;
use axum::body::Bytes;
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Redirect, Response};
use axum::routing::get;
use sha2::{Digest, Sha256};
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;
use terrafarm_wire::link::FarmToken;
use tokio::sync::Semaphore;

/// What the key is for, in its derivation. Never changed: bookmarked keys depend on it.
const PURPOSE: &str = "terrafarm web key 1";
/// Bytes of the key: 128 bits cannot be guessed.
const KEY_BYTES: usize = 16;
/// Name of the cookie.
const COOKIE: &str = "terrafarm-key";
/// How long a wrong key takes to be refused.
const WRONG_KEY_PAUSE: Duration = Duration::from_secs(1);
/// Wrong keys that are refused at once; further ones are turned away unread.
const WRONG_KEYS: usize = 8;
/// Longest form that is read, bytes.
const FORM_BYTES_MAX: usize = 1 << 10;
/// How long it may take to come.
const FORM_LIMIT: Duration = Duration::from_secs(10);

/// What lets a browser or a script in. `Debug` does not show it.
#[derive(Clone)]
pub struct WebKey(String);

impl WebKey {
    /// That of a farm.
    pub fn of(token: &FarmToken) -> Self {
        let bytes = token.derive(PURPOSE);
        WebKey(bytes[..KEY_BYTES].iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// As it is typed: 32 hexadecimal digits.
    pub fn as_text(&self) -> &str {
        &self.0
    }

    /// Whether a text is the key. Takes the same time for every text: digests are compared,
    /// and all of them.
    fn is(&self, text: &str) -> bool {
        let [one, other] = [self.0.as_str(), text].map(|text| Sha256::digest(text.as_bytes()));
        let different = one.iter().zip(&other).fold(0, |sum, (one, other)| sum | (one ^ other));
        std::hint::black_box(different) == 0
    }
}

impl std::fmt::Debug for WebKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("WebKey(secret)")
    }
}

/// Who is let in.
#[derive(Debug, Clone)]
pub struct Access {
    /// What everyone has to show; nobody if `None`.
    pub key: Option<WebKey>,
    /// Names of this PC that may stand in `Host`, beside `localhost` and addresses. Of no
    /// importance where there is a key, which strange pages do not have.
    pub names: Vec<String>,
}

struct Door {
    access: Access,
    wrong_keys: Semaphore,
}

/// Puts the door before the routes.
pub(super) fn guard(router: Router, access: Access) -> Router {
    let door = Arc::new(Door { access, wrong_keys: Semaphore::new(WRONG_KEYS) });
    let login = Router::new()
        .route("/login", get(show_login).post(login))
        .layer(DefaultBodyLimit::max(FORM_BYTES_MAX))
        .layer(middleware::from_fn(|request, next| in_time(FORM_LIMIT, request, next)))
        .with_state(door.clone());
    router
        .merge(login)
        .layer(middleware::from_fn_with_state(door, let_in))
        .layer(middleware::from_fn(harden))
}

async fn let_in(State(door): State<Arc<Door>>, request: Request, next: Next) -> Response {
    if let Err(refused) = door.access.check_source(request.method(), request.headers()) {
        return closing(refused.into_response());
    }
    let Some(key) = door.access.key.as_ref() else { return next.run(request).await };
    let path = request.uri().path();
    // What has to be seen before the key is given, and tells nothing of the farm.
    let open = ["/login", "/page.css", "/icon.svg", "/healthz"].contains(&path);
    match shown(request.headers()) {
        Some(text) if key.is(text) => next.run(request).await,
        _ if open => closing(next.run(request).await),
        None if path == "/" => closing(Redirect::to("/login").into_response()),
        None => closing(Refusal::new(StatusCode::UNAUTHORIZED, NEEDS_KEY).into_response()),
        Some(_) if path == "/" => door.pause(Redirect::to("/login").into_response()).await,
        Some(_) => {
            let text = "that is not the key of this farm; \"terrafarm token --web\" prints it";
            door.pause(Refusal::new(StatusCode::UNAUTHORIZED, text).into_response()).await
        }
    }
}

const NEEDS_KEY: &str = "this farm's key is needed, as \"Authorization: Bearer KEY\"; \
                         \"terrafarm token --web\" prints it on the coordinator's PC";

/// Whoever is not let in does not keep the connection either.
fn closing(mut response: Response) -> Response {
    response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    response
}

impl Door {
    /// An answer to a wrong key, after a while.
    async fn pause(&self, response: Response) -> Response {
        let Ok(_turn) = self.wrong_keys.try_acquire() else {
            let text = "too many wrong keys at once; try again in a second";
            return closing(Refusal::new(StatusCode::TOO_MANY_REQUESTS, text).into_response());
        };
        // The pause is the purpose: keys are not to be guessed fast.
        tokio::time::sleep(WRONG_KEY_PAUSE).await;
        closing(response)
    }
}

impl Access {
    /// Refuses what a strange page in a browser would send.
    fn check_source(&self, method: &Method, headers: &HeaderMap) -> Result<(), Refusal> {
        let text = |name: HeaderName| headers.get(name).and_then(|value| value.to_str().ok());
        let host = text(header::HOST).unwrap_or_default();
        if self.key.is_none() && !self.is_ours(host) {
            let text = format!(
                "{host:?} is no address of this PC and none of its names; use one, or say \
                 --http-name when you start the coordinator"
            );
            return Err(Refusal::new(StatusCode::MISDIRECTED_REQUEST, text));
        }
        let foreign = || {
            let text =
                "another site asked for this; if that is a proxy of yours, let it pass Host on";
            Err(Refusal::new(StatusCode::FORBIDDEN, text))
        };
        if let Some(origin) = headers.get(header::ORIGIN) {
            let same = origin.to_str().ok().and_then(|origin| origin.split_once("://"));
            if !same.is_some_and(|(_, authority)| authority.eq_ignore_ascii_case(host)) {
                return foreign();
            }
        }
        let reads = matches!(*method, Method::GET | Method::HEAD);
        let site = text(HeaderName::from_static("sec-fetch-site"));
        // Someone may follow a link to the page, from anywhere.
        let follows = reads && text(HeaderName::from_static("sec-fetch-mode")) == Some("navigate");
        match site {
            Some("cross-site" | "same-site") if !follows => foreign(),
            _ => Ok(()),
        }
    }

    /// Whether a `Host` is an address, `localhost`, or one of this PC's names.
    fn is_ours(&self, host: &str) -> bool {
        let name = match host.strip_prefix('[') {
            Some(rest) => rest.split_once(']').map_or("", |(name, _)| name),
            None => host.split(':').next().unwrap_or_default(),
        };
        let is = |known: &str| name.trim_end_matches('.').eq_ignore_ascii_case(known);
        name.parse::<IpAddr>().is_ok()
            || is("localhost")
            || self.names.iter().any(|known| is(known))
    }
}

/// The key that a request shows.
fn shown(headers: &HeaderMap) -> Option<&str> {
    let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
    if let Some(bearer) = text(header::AUTHORIZATION) {
        return bearer.strip_prefix("Bearer ").map(str::trim);
    }
    let cookies = headers.get_all(header::COOKIE).iter().filter_map(|value| value.to_str().ok());
    let mut pairs =
        cookies.flat_map(|cookies| cookies.split(';')).filter_map(|one| one.split_once('='));
    pairs.find(|(name, _)| name.trim() == COOKIE).map(|(_, value)| value.trim())
}

/// `GET /login`
async fn show_login() -> Response {
    page::send("text/html; charset=utf-8", include_str!("page/login.html"))
}

/// `POST /login`, a form with the field `key`.
async fn login(State(door): State<Arc<Door>>, body: Bytes) -> Response {
    let Some(key) = &door.access.key else { return Redirect::to("/").into_response() };
    let form = String::from_utf8_lossy(&body);
    // Hexadecimal digits need no decoding; blanks around them are a slip.
    let digits = |text: &str| text.chars().filter(char::is_ascii_hexdigit).collect::<String>();
    let given = form.strip_prefix("key=").map(|text| digits(&text.replace("%20", "")));
    if !given.is_some_and(|given| key.is(&given.to_ascii_lowercase())) {
        return door.pause(Redirect::to("/login?wrong").into_response()).await;
    }
    let cookie = format!("{COOKIE}={}; HttpOnly; SameSite=Strict; Path=/", key.as_text());
    ([(header::SET_COOKIE, cookie)], Redirect::to("/")).into_response()
}

/// Headers that leave a browser no room: nothing from elsewhere, no script in the page, no
/// guesses about types, no frames, no address passed on.
async fn harden(request: Request, next: Next) -> Response {
    const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
                          img-src 'self'; media-src 'self'; connect-src 'self'; \
                          form-action 'self'; frame-ancestors 'none'; base-uri 'none'";
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    for (name, value) in [
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        // With none at all, browsers would send forms of this page without an origin.
        (header::REFERRER_POLICY, "same-origin"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

#[cfg(test)]
mod tests {
    use super::*;
    use axum::body::Body;
    use tower::ServiceExt;

    fn headers(pairs: &[(&'static str, &str)]) -> HeaderMap {
        let pair = |&(name, value): &(&'static str, &str)| {
            (HeaderName::from_static(name), HeaderValue::from_str(value).expect("a value"))
        };
        pairs.iter().map(pair).collect()
    }

    #[test]
    fn the_key_is_of_the_token_and_does_not_show_it() {
        let token = FarmToken::from_bytes([7; 32]);
        let key = WebKey::of(&token);
        assert_eq!(key.as_text().len(), 32);
        assert!(key.is(WebKey::of(&token).as_text()));
        assert!(!key.is(WebKey::of(&FarmToken::from_bytes([8; 32])).as_text()));
        assert!(!key.is("") && !key.is(&key.as_text()[1..]));
        assert!(!"07070707".contains(&key.as_text()[..8]));
        assert_eq!(format!("{key:?}"), "WebKey(secret)");
    }

    #[test]
    fn only_addresses_and_names_of_this_pc_are_hosts() {
        let access = Access { key: None, names: vec!["PC-One".into()] };
        for host in
            ["127.0.0.1:7071", "localhost", "[::1]:7071", "pc-one:80", "10.0.0.3", "localhost."]
        {
            assert!(access.is_ours(host), "{host}");
        }
        for host in
            ["", "evil.example", "localhost.evil.example:7071", "pc-one.evil.example", "[x]"]
        {
            assert!(!access.is_ours(host), "{host}");
        }
    }

    #[test]
    fn pages_of_other_sites_are_refused() {
        let access = Access { key: None, names: Vec::new() };
        let check = |method: Method, more: &[(&'static str, &str)]| {
            let mut pairs = vec![("host", "127.0.0.1:7071")];
            pairs.extend_from_slice(more);
            access.check_source(&method, &headers(&pairs)).is_ok()
        };
        assert!(check(Method::POST, &[]), "scripts send no origin");
        assert!(check(Method::POST, &[("origin", "http://127.0.0.1:7071")]));
        assert!(!check(Method::POST, &[("origin", "http://127.0.0.1:8080")]));
        assert!(!check(Method::POST, &[("origin", "null")]));
        assert!(!check(Method::GET, &[("origin", "https://evil.example")]));
        assert!(!check(Method::POST, &[("sec-fetch-site", "cross-site")]));
        assert!(!check(
            Method::GET,
            &[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "no-cors")]
        ));
        assert!(check(
            Method::GET,
            &[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "navigate")]
        ));
        assert!(!check(
            Method::POST,
            &[("sec-fetch-site", "cross-site"), ("sec-fetch-mode", "navigate")]
        ));
        assert!(access.check_source(&Method::GET, &headers(&[("host", "evil.example")])).is_err());
    }

    /// What is behind the door says "in".
    fn door(key: &WebKey) -> Router {
        let access = Access { key: Some(key.clone()), names: Vec::new() };
        guard(Router::new().route("/healthz", get(|| async { "in" })), access)
    }

    #[tokio::test]
    async fn strangers_keep_no_connection() {
        let key = WebKey::of(&FarmToken::from_bytes([7; 32]));
        let bearer = format!("Bearer {}", key.as_text());
        let foreign = ("origin", "http://evil.example");
        for (path, header, closes) in [
            ("/healthz", None, true),
            ("/login", None, true),
            ("/api/v1/farm", None, true),
            ("/healthz", Some(foreign), true),
            ("/healthz", Some(("authorization", bearer.as_str())), false),
        ] {
            let mut request = Request::get(path);
            if let Some((name, value)) = header {
                request = request.header(name, value);
            }
            let request = request.body(Body::empty()).expect("a request");
            let response = door(&key).oneshot(request).await.expect("infallible");
            let close = response.headers().get(header::CONNECTION).is_some();
            assert_eq!(close, closes, "{path} {header:?}");
        }
    }

    #[test]
    fn a_form_that_does_not_come_is_not_waited_for() {
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = runtime.enable_time().start_paused(true).build().expect("a runtime");
        runtime.block_on(async {
            let key = WebKey::of(&FarmToken::from_bytes([7; 32]));
            let never = tokio_stream::pending::<Result<Bytes, std::io::Error>>();
            let request = Request::post("/login").body(Body::from_stream(never));
            let answered = door(&key).oneshot(request.expect("a request"));
            let answered = tokio::time::timeout(10 * FORM_LIMIT, answered).await;
            let status = answered.expect("in time").expect("infallible").status();
            assert_eq!(status, StatusCode::REQUEST_TIMEOUT);
        });
    }

    #[test]
    fn keys_are_found_in_headers_and_cookies() {
        assert_eq!(shown(&headers(&[("authorization", "Bearer abc")])), Some("abc"));
        assert_eq!(shown(&headers(&[("authorization", "Basic abc")])), None);
        assert_eq!(shown(&headers(&[("cookie", "a=b; terrafarm-key=abc; c=d")])), Some("abc"));
        assert_eq!(shown(&headers(&[("cookie", "not-terrafarm-key=abc")])), None);
    }
}
