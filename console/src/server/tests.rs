use super::*;
use crate::run::{Run, Watch};
use crate::session::Sessions;
use axum::body::Body;
use axum::body::to_bytes;
use axum::extract::Request;
use axum::http::HeaderMap;
use axum::http::Method;
use axum::http::header::CONTENT_SECURITY_POLICY;
use heightmap::ChangeRules;
use tower::ServiceExt as _;

const TOKEN: &str = "0123456789abcdef";
const HOST_NAME: &str = "127.0.0.1:8750";

struct Client {
    router: Router,
    _end: tokio_util::sync::DropGuard,
}

struct Answer {
    status: StatusCode,
    headers: HeaderMap,
    text: String,
}

impl Answer {
    fn json(&self) -> serde_json::Value {
        serde_json::from_str(&self.text).unwrap()
    }
}

impl Client {
    fn new() -> Self {
        let watch = Watch {
            nodes: Vec::new(),
            executor: "/suction_executor".into(),
            stale_after: Duration::from_secs(3),
            changes: ChangeRules::default(),
        };
        let sessions = Sessions::new(4, Duration::from_secs(60));
        let console = Arc::new(Console::new(Run::new(watch), sessions));
        let trainings = Trainings::new(
            "no/such/program".into(),
            "recipe".into(),
            "no/such/folder".into(),
            "checkpoint".into(),
        );
        let page = Page {
            console,
            libraries: Arc::new(Libraries::new(std::path::Path::new("no/such/folder"))),
            checkpoints: Arc::new(Checkpoints::new(["no/such".into(), "folder".into()])),
            trainings: Arc::new(trainings),
            cameras: Arc::new(Cameras::new(&["front".into()], "world")),
        };
        let address = HOST_NAME.parse().unwrap();
        let access = Access::new(TOKEN.into(), address, &["cell.example".into()], false);
        let end = CancellationToken::new();
        Self {
            router: router(page, access, end.clone()),
            _end: end.drop_guard(),
        }
    }

    /// Headers replace the right ones.
    async fn ask(
        &self,
        method: Method,
        path: &str,
        headers: &[(&str, &str)],
        body: &str,
    ) -> Answer {
        let mut request = Request::builder().method(method).uri(path);
        let right = [
            ("host", HOST_NAME),
            ("authorization", &format!("Bearer {TOKEN}")),
            ("content-type", "application/json"),
        ];
        let given = |name: &str| headers.iter().any(|(given, _)| *given == name);
        let kept = right.iter().filter(|(name, _)| !given(name));
        for (name, value) in kept.chain(headers) {
            request = request.header(*name, *value);
        }
        let request = request.body(Body::from(body.to_owned())).unwrap();
        let response = self.router.clone().oneshot(request).await.unwrap();
        let (parts, body) = response.into_parts();
        let bytes = to_bytes(body, 1 << 20).await.unwrap();
        Answer {
            status: parts.status,
            headers: parts.headers,
            text: String::from_utf8_lossy(&bytes).into_owned(),
        }
    }

    async fn join(&self, name: &str) -> (u64, String) {
        let body = format!(r#"{{"name": "{name}"}}"#);
        let joined = self
            .ask(Method::POST, "/api/v1/sessions", &[], &body)
            .await
            .json();
        let session = joined["session"].as_str().unwrap().to_owned();
        (joined["viewer"].as_u64().unwrap(), session)
    }

    async fn post(&self, path: &str, session: &str, body: &str) -> Answer {
        self.ask(Method::POST, path, &[("x-session", session)], body)
            .await
    }
}

#[tokio::test]
async fn without_the_right_token_nothing_is_told() {
    let client = Client::new();
    for token in [
        "",
        "Bearer",
        "Bearer ",
        "Bearer 0123456789abcdeX",
        "Basic 0123456789abcdef",
    ] {
        let answer = client
            .ask(
                Method::GET,
                "/api/v1/state",
                &[("authorization", token)],
                "",
            )
            .await;
        assert_eq!(answer.status, StatusCode::UNAUTHORIZED, "{token:?}");
        assert!(!answer.text.contains("phase"), "{}", answer.text);
    }
    let answer = client.ask(Method::GET, "/api/v1/state", &[], "").await;
    assert_eq!(answer.status, StatusCode::OK);
    assert_eq!(answer.json()["phase"], "no_goal");
}

#[tokio::test]
async fn a_page_of_another_site_and_another_name_for_this_machine_are_refused() {
    let client = Client::new();
    let origin = |origin| [("origin", origin)];
    for foreign in [
        "http://evil.example",
        "https://127.0.0.1:8750",
        "http://127.0.0.1:1",
        "null",
    ] {
        let answer = client
            .ask(Method::GET, "/api/v1/state", &origin(foreign), "")
            .await;
        assert_eq!(answer.status, StatusCode::FORBIDDEN, "{foreign}");
    }
    for ours in [
        "http://127.0.0.1:8750",
        "http://localhost:8750",
        "http://cell.example:8750",
    ] {
        let answer = client
            .ask(Method::GET, "/api/v1/state", &origin(ours), "")
            .await;
        assert_eq!(answer.status, StatusCode::OK, "{ours}");
    }
    let answer = client
        .ask(Method::GET, "/", &[("host", "evil.example:8750")], "")
        .await;
    assert_eq!(answer.status, StatusCode::MISDIRECTED_REQUEST);
    // The WebSocket too, before any token is shown.
    let answer = client
        .ask(
            Method::GET,
            "/api/v1/live",
            &origin("http://evil.example"),
            "",
        )
        .await;
    assert_eq!(answer.status, StatusCode::FORBIDDEN);
}

#[tokio::test]
async fn the_page_needs_no_token_and_may_load_nothing_from_elsewhere() {
    let client = Client::new();
    for (path, content_type, contents) in PAGE {
        let answer = client
            .ask(Method::GET, path, &[("authorization", "")], "")
            .await;
        assert_eq!(answer.status, StatusCode::OK, "{path}");
        assert_eq!(answer.headers[CONTENT_TYPE], content_type);
        assert!(!contents.is_empty(), "{path}");
        let policy = answer.headers[CONTENT_SECURITY_POLICY].to_str().unwrap();
        assert!(policy.contains("default-src 'none'"), "{policy}");
        assert!(!policy.contains("unsafe"), "{policy}");
        let text = String::from_utf8_lossy(contents);
        let elsewhere = text
            .split(['"', '\'', '(', ' '])
            .filter(|word| word.contains("//") && word.starts_with("http"))
            // A name, not an address.
            .filter(|word| !word.starts_with("http://www.w3.org/"));
        assert_eq!(elsewhere.collect::<Vec<_>>(), [""; 0], "{path}");
    }
}

#[tokio::test]
async fn who_watches_decides_nothing_and_who_has_given_control_away_neither() {
    let client = Client::new();
    let (ada, first) = client.join("Ada").await;
    let (bob, second) = client.join("Bob").await;
    let approve = r#"{"proposal_id": "7", "decision": "approve"}"#;
    let answer = client.post("/api/v1/decisions", &first, approve).await;
    assert_eq!(answer.status, StatusCode::CONFLICT);
    assert!(answer.text.contains("Nobody decides"), "{}", answer.text);
    let take = client
        .post(
            "/api/v1/operator",
            &first,
            r#"{"action": "take", "from": null}"#,
        )
        .await;
    assert_eq!(take.status, StatusCode::NO_CONTENT, "{}", take.text);
    // The operator, and there is nothing to approve.
    let answer = client.post("/api/v1/decisions", &first, approve).await;
    assert!(answer.text.contains("no goal"), "{}", answer.text);
    let over = format!(r#"{{"action": "take", "from": {ada}}}"#);
    let take = client.post("/api/v1/operator", &second, &over).await;
    assert_eq!(take.status, StatusCode::NO_CONTENT, "{}", take.text);
    let answer = client.post("/api/v1/decisions", &first, approve).await;
    assert!(answer.text.contains("Bob decides"), "{}", answer.text);
    let state = client
        .ask(Method::GET, "/api/v1/state", &[], "")
        .await
        .json();
    assert_eq!(state["operator"], bob);
    assert!(!state.to_string().contains(&first), "keys are secret");
}

#[tokio::test]
async fn a_request_that_makes_no_sense_is_refused_with_words() {
    let client = Client::new();
    let (_, session) = client.join("Ada").await;
    for (path, body) in [
        ("/api/v1/decisions", "{}"),
        ("/api/v1/decisions", "nonsense"),
        (
            "/api/v1/decisions",
            r#"{"proposal_id": "7", "decision": "explode"}"#,
        ),
        (
            "/api/v1/decisions",
            r#"{"proposal_id": "-1", "decision": "approve"}"#,
        ),
        (
            "/api/v1/decisions",
            r#"{"proposal_id": "7", "decision": "approve", "more": 1}"#,
        ),
        ("/api/v1/step", r#"{"step": -1}"#),
        ("/api/v1/operator", r#"{"action": "seize"}"#),
        ("/api/v1/sessions", r#"{"name": ""}"#),
    ] {
        let answer = client.post(path, &session, body).await;
        assert!(
            answer.status.is_client_error(),
            "{path} {body}: {}",
            answer.status
        );
        assert!(
            answer.json()["reason"].is_string(),
            "{path} {body}: {}",
            answer.text
        );
    }
    let large = format!(r#"{{"name": "{}"}}"#, "x".repeat(LARGEST_BODY));
    let answer = client.post("/api/v1/sessions", &session, &large).await;
    assert_eq!(answer.status, StatusCode::PAYLOAD_TOO_LARGE);
    let form = [("content-type", "application/x-www-form-urlencoded")];
    let answer = client
        .ask(Method::POST, "/api/v1/sessions", &form, "name=Ada")
        .await;
    assert_eq!(answer.status, StatusCode::UNSUPPORTED_MEDIA_TYPE);
    let answer = client.post("/api/v1/home", "no such session", "{}").await;
    assert_eq!(answer.status, StatusCode::UNAUTHORIZED);
    for path in [
        "/api/v1/heightmaps/present",
        "/api/v1/cameras/front",
        "/api/v1/robot_description",
        "/api/v1/heightmaps/goal-x",
        "/api/v1/nothing",
        "/../Cargo.toml",
    ] {
        let answer = client.ask(Method::GET, path, &[], "").await;
        assert_eq!(answer.status, StatusCode::NOT_FOUND, "{path}");
    }
    // What was decided on while a page asks for it is no fault of anybody.
    for path in ["/api/v1/motion", "/api/v1/scores"] {
        let answer = client.ask(Method::GET, path, &[], "").await;
        assert_eq!(answer.status, StatusCode::NO_CONTENT, "{path}");
    }
}

const DESCRIPTION: &str = include_str!("../../../docs/operator_console.openapi.yaml");

/// Method and path of every route that the source has.
fn routes() -> Vec<(String, String)> {
    let source = include_str!("../server.rs");
    let words: String = source.split_whitespace().collect();
    let routes = words.split(".route(\"").skip(1).filter_map(|rest| {
        let (path, rest) = rest.split_once("\",")?;
        let (method, _) = rest.split_once('(')?;
        let prefix = if path.starts_with("/api/v1/") {
            ""
        } else {
            "/api/v1"
        };
        Some((method.to_owned(), format!("{prefix}{path}")))
    });
    routes.collect()
}

#[test]
fn the_description_has_every_route_and_no_other() {
    let description: serde_json::Value = serde_yaml_ng::from_str(DESCRIPTION).unwrap();
    let paths = description["paths"].as_object().unwrap();
    let described = paths.iter().flat_map(|(path, item)| {
        let methods = item.as_object().unwrap().keys();
        methods.map(move |method| (method.clone(), path.clone()))
    });
    let mut described: Vec<_> = described.collect();
    let mut routes = routes();
    described.sort();
    routes.sort();
    assert!(routes.len() > 10, "{routes:?}");
    assert_eq!(described, routes);
}

/// What of a value a schema does not describe.
fn undescribed(
    description: &serde_json::Value,
    schema: &serde_json::Value,
    value: &serde_json::Value,
    at: &str,
) -> Vec<String> {
    use serde_json::Value;
    if let Some(reference) = schema["$ref"].as_str() {
        let schema = description.pointer(reference.trim_start_matches('#'));
        return undescribed(description, schema.unwrap(), value, at);
    }
    if let Some(choices) = schema["oneOf"].as_array() {
        let mistakes = |choice| undescribed(description, choice, value, at);
        let all: Vec<_> = choices.iter().map(mistakes).collect();
        let fits = all.iter().any(Vec::is_empty);
        return if fits { Vec::new() } else { all.concat() };
    }
    let kind = match value {
        Value::Null => "null",
        Value::Bool(_) => "boolean",
        Value::Number(number) if number.is_f64() => "number",
        Value::Number(_) => "integer",
        Value::String(_) => "string",
        Value::Array(_) => "array",
        Value::Object(_) => "object",
    };
    let is = |expected: &Value| expected == kind || expected == "number" && kind == "integer";
    let right = match &schema["type"] {
        Value::Array(kinds) => kinds.iter().any(is),
        Value::Null => true,
        expected => is(expected),
    };
    if !right {
        return vec![format!("{at} is {kind}, described as {}", schema["type"])];
    }
    let mut mistakes = Vec::new();
    let chosen = schema["enum"].as_array();
    let constant = &schema["const"];
    if chosen.is_some_and(|values| !values.contains(value))
        || !constant.is_null() && constant != value
    {
        mistakes.push(format!(
            "{at} is {value}, which the description does not have"
        ));
    }
    for item in value.as_array().into_iter().flatten() {
        let at = format!("{at}[]");
        mistakes.extend(undescribed(description, &schema["items"], item, &at));
    }
    if let Some(object) = value.as_object() {
        for (name, value) in object {
            let at = format!("{at}.{name}");
            let known = &schema["properties"][name];
            let schema = if known.is_null() {
                &schema["additionalProperties"]
            } else {
                known
            };
            match schema.is_null() {
                true => mistakes.push(format!("{at} is not described")),
                false => mistakes.extend(undescribed(description, schema, value, &at)),
            }
        }
        for name in schema["required"].as_array().into_iter().flatten() {
            if !object.contains_key(name.as_str().unwrap()) {
                mistakes.push(format!("{at} has no {name}"));
            }
        }
    }
    mistakes
}

#[test]
fn the_description_tells_every_field_of_the_state() {
    let description: serde_json::Value = serde_yaml_ng::from_str(DESCRIPTION).unwrap();
    let console = crate::state::tests::with_everything();
    let state: serde_json::Value = serde_json::from_str(
        &console
            .snapshot(Some(crate::training::tests::state()))
            .unwrap(),
    )
    .unwrap();
    for field in [
        "heightmap",
        "goal",
        "proposal",
        "lesson",
        "policy",
        "training",
        "home",
        "reward",
        "joints",
        "motion",
        "scores",
    ] {
        assert!(!state[field].is_null(), "{field}: {state}");
    }
    for list in ["steps", "notices", "streams", "viewers"] {
        assert!(
            !state[list].as_array().unwrap().is_empty(),
            "{list}: {state}"
        );
    }
    let schema = &description["components"]["schemas"]["State"];
    assert_eq!(undescribed(&description, schema, &state, "state"), [""; 0]);
}

#[tokio::test]
async fn answers_are_what_the_description_says() {
    let description: serde_json::Value = serde_yaml_ng::from_str(DESCRIPTION).unwrap();
    let client = Client::new();
    for path in [
        "/api/v1/state",
        "/api/v1/cameras",
        "/api/v1/checkpoints",
        "/api/v1/demonstrations",
        "/api/v1/lesson/settings",
        "/api/v1/training/comparison",
    ] {
        let answer = client.ask(Method::GET, path, &[], "").await;
        assert_eq!(answer.status, StatusCode::OK, "{path}");
        let schema = &description["paths"][path]["get"]["responses"]["200"]["content"]["application/json"]
            ["schema"];
        assert!(schema.is_object(), "{path}");
        let mistakes = undescribed(&description, schema, &answer.json(), path);
        assert_eq!(mistakes, [""; 0]);
    }
}
