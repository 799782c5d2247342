use super::*;
use crate::run::Run;
use crate::session::Sessions;
use axum::body::Body;
use axum::body::to_bytes;
use axum::extract::Request;
use axum::http::HeaderMap;
use axum::http::Method;
use axum::http::header::CONTENT_SECURITY_POLICY;
use heightmap::Intrinsics;
use nalgebra::Isometry3;
use serde_json::{Value, json};
use std::path::Path;
use tower::ServiceExt as _;

const TOKEN: &str = "0123456789abcdef";
const HOST_NAME: &str = "127.0.0.1:8750";

/// A page whose files lie in a folder.
pub(crate) fn page(console: Console, folder: &Path) -> Page {
    let settings = PageSettings {
        library: folder.join("library"),
        checkpoint: "checkpoint".into(),
        sctn: "no/such/program".into(),
        recipe: "recipe".into(),
        training: folder.join("training"),
        cameras: vec!["front".into()],
        ..PageSettings::default()
    };
    Page {
        console: Arc::new(console),
        checkpoints: Arc::new(Checkpoints::new([folder.into(), "no/such/folder".into()])),
        ..Page::new(&settings, crate::samples::watch(&[]))
    }
}

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
    /// Of a console that has heard nothing.
    fn new() -> Self {
        let sessions = Sessions::new(4, Duration::from_secs(60));
        let console = Console::new(Run::new(crate::samples::watch(&[])), sessions);
        Self::of(page(console, Path::new("no/such/folder")))
    }

    fn of(page: Page) -> Self {
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
async fn that_somebody_decides_now_is_said_before_their_first_decision() {
    let (console, ..) = crate::state::tests::proposed();
    let mut commands = console.connect();
    let client = Client::of(page(console, Path::new("no/such/folder")));
    let hand_over = r#"{"action": "hand_over", "to": null}"#;
    let take = r#"{"action": "take", "from": null}"#;
    for change in [hand_over, take] {
        let answer = client.post("/api/v1/operator", "key", change).await;
        assert_eq!(answer.status, StatusCode::NO_CONTENT, "{}", answer.text);
        assert_eq!(commands.try_recv(), Ok(crate::Command::Presence));
    }
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

/// A page that has something of everything, in an empty folder.
fn page_with_everything(folder: &Path) -> Page {
    let page = page(crate::state::tests::with_everything(), folder);
    let demonstration = crate::state::tests::demonstration("blocks");
    let Libraries {
        tasks,
        corrections,
        history,
    } = &*page.libraries;
    tasks.save("blocks", &demonstration).unwrap();
    corrections
        .save("blocks-1-0000000000000007", &demonstration)
        .unwrap();
    let began = crate::history::RunEvent::Began {
        run: 7,
        demonstration: "blocks".into(),
        goals: "blocks/0".into(),
        checkpoint: "one".into(),
    };
    history.add(began).unwrap();
    std::fs::write(folder.join("one.safetensors"), "").unwrap();
    crate::training::tests::give_example(&page.trainings);
    let cameras = &page.cameras;
    cameras.on_intrinsics("front", Intrinsics::RAVENS);
    cameras.on_image("front", Duration::ZERO, "optical".into(), vec![]);
    cameras
        .on_transform("world", "optical", Isometry3::identity())
        .unwrap();
    page
}

/// What the description has of a path: the schema of the JSON that a method is answered with.
fn schema_of_answer<'a>(description: &'a Value, path: &str, method: &str) -> &'a Value {
    &description["paths"][path][method]["responses"]["200"]["content"]["application/json"]["schema"]
}

#[tokio::test]
async fn answers_are_what_the_description_says() {
    let description: Value = serde_yaml_ng::from_str(DESCRIPTION).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let client = Client::of(page_with_everything(folder.path()));
    let mut compared = 0;
    for path in description["paths"].as_object().unwrap().keys() {
        let schema = schema_of_answer(&description, path, "get");
        if schema.is_null() {
            continue;
        }
        let answer = client.ask(Method::GET, path, &[], "").await;
        assert_eq!(answer.status, StatusCode::OK, "{path}: {}", answer.text);
        // A list without anything would fit every description.
        let answer = answer.json();
        let is_empty = |value: &Value| value.as_array().is_some_and(Vec::is_empty);
        let mut parts = answer
            .as_object()
            .into_iter()
            .flat_map(|object| object.values());
        let is_full = path == "/api/v1/state" || !is_empty(&answer) && !parts.any(is_empty);
        assert!(is_full, "{path}: {answer}");
        let mistakes = undescribed(&description, schema, &answer, path);
        assert_eq!(mistakes, [""; 0]);
        compared += 1;
    }
    assert_eq!(compared, 7);
}

/// The schema that is meant where another one is named.
fn meant<'a>(description: &'a Value, schema: &'a Value) -> &'a Value {
    match schema["$ref"].as_str() {
        Some(reference) => description
            .pointer(reference.trim_start_matches('#'))
            .unwrap(),
        None => schema,
    }
}

/// A value that a schema describes, with everything that may be in it.
fn example(description: &Value, schema: &Value) -> Value {
    let schema = meant(description, schema);
    if let Some(value) = [&schema["const"], &schema["enum"][0]]
        .into_iter()
        .find(|value| !value.is_null())
    {
        return value.clone();
    }
    let kind = schema["type"][0].as_str().or(schema["type"].as_str());
    match kind.unwrap() {
        "string" => json!("7"),
        "integer" => json!(1),
        "number" => json!(0.5),
        "boolean" => json!(true),
        "array" => json!([example(description, &schema["items"])]),
        "object" => {
            let properties = schema["properties"].as_object().unwrap();
            let filled = properties
                .iter()
                .map(|(name, schema)| (name.clone(), example(description, schema)));
            Value::Object(filled.collect())
        }
        other => panic!("{other} is not in the descriptions of requests"),
    }
}

/// Values that a schema does not describe, each with one mistake: something left out, of another type, or too much.
fn mistaken(description: &Value, schema: &Value, right: &Value) -> Vec<Value> {
    let schema = meant(description, schema);
    let Value::Object(object) = right else {
        return vec![if right.is_string() {
            json!(7)
        } else {
            json!("seven")
        }];
    };
    let with = |name: &str, value: Option<Value>| {
        let mut changed = object.clone();
        match value {
            Some(value) => changed.insert(name.into(), value),
            None => changed.remove(name),
        };
        Value::Object(changed)
    };
    let required = schema["required"].as_array().into_iter().flatten();
    let mut all: Vec<_> = required
        .map(|name| with(name.as_str().unwrap(), None))
        .collect();
    all.push(with("more", Some(json!(1))));
    for (name, value) in object {
        let changes = mistaken(description, &schema["properties"][name], value);
        all.extend(changes.into_iter().map(|value| with(name, Some(value))));
    }
    all
}

#[tokio::test]
async fn requests_are_taken_as_the_description_says_and_no_others() {
    let description: Value = serde_yaml_ng::from_str(DESCRIPTION).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut bodies = 0;
    for (path, item) in description["paths"].as_object().unwrap() {
        if item["post"].is_null() {
            continue;
        }
        let schema = &item["post"]["requestBody"]["content"]["application/json"]["schema"];
        let variants = schema["oneOf"].as_array().cloned();
        for schema in variants.unwrap_or_else(|| vec![schema.clone()]) {
            let (console, _, _commands) = crate::state::tests::proposed();
            let client = Client::of(page(console, folder.path()));
            let right = match schema.is_null() {
                true => json!({}),
                false => example(&description, &schema),
            };
            let answer = client.post(path, "key", &right.to_string()).await;
            let status = answer.status.as_u16().to_string();
            let described = &item["post"]["responses"][&status];
            assert!(
                described.is_object(),
                "{path} {right}: {status} {}",
                answer.text
            );
            if answer.status == StatusCode::OK {
                let schema = schema_of_answer(&description, path, "post");
                let mistakes = undescribed(&description, schema, &answer.json(), path);
                assert_eq!(mistakes, [""; 0]);
            }
            if schema.is_null() {
                continue;
            }
            bodies += 1;
            for wrong in mistaken(&description, &schema, &right) {
                let answer = client.post(path, "key", &wrong.to_string()).await;
                let refused = [StatusCode::BAD_REQUEST, StatusCode::UNPROCESSABLE_ENTITY];
                assert!(
                    refused.contains(&answer.status),
                    "{path} {wrong}: {}",
                    answer.text
                );
            }
        }
    }
    assert_eq!(bodies, 12);
}

/// The page's scripts and what they import.
#[test]
fn the_page_is_the_files_of_this_repository_and_nothing_else() {
    let served = PAGE.map(|(path, ..)| path);
    for (path, _, contents) in PAGE {
        let text = String::from_utf8_lossy(contents);
        let named = text
            .split([' ', '\n', '(', '='])
            .filter_map(|word| word.strip_prefix('"')?.split('"').next())
            .filter(|name| {
                [".js", ".css", ".svg"]
                    .iter()
                    .any(|end| name.ends_with(end))
            });
        for name in named {
            let name = format!("/{}", name.trim_start_matches("./"));
            assert!(served.contains(&name.as_str()), "{path} loads {name}");
        }
        for dynamic in ["import(", "eval(", "importScripts", "new Function"] {
            assert!(!text.contains(dynamic), "{path}: {dynamic}");
        }
    }
}
