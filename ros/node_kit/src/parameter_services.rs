//! The parameter services of a node, and `/parameter_events`.

use std::sync::Arc;

use msgs::rcl_interfaces::{
    DescribeParameters, DescribeParametersResponse, GetParameterTypes, GetParameterTypesResponse,
    GetParameters, GetParametersResponse, ListParameters, ListParametersResponse, ParameterEvent,
    SetParameters, SetParametersAtomically, SetParametersAtomicallyResponse, SetParametersResponse,
    SetParametersResult,
};
use tracing::info;

use crate::{
    clock::Clock,
    node::{Node, NodeError},
    parameter_store::ParameterStore,
    qos::Qos,
    topic::Publisher,
};

/// Sets parameters and says so.
struct Setter {
    store: Arc<ParameterStore>,
    events: Publisher<ParameterEvent>,
    node: String,
    clock: Clock,
}

impl Setter {
    fn set(&self, parameters: &[msgs::rcl_interfaces::Parameter]) -> SetParametersResult {
        match self.store.set(parameters) {
            Ok(changed) => {
                if !changed.is_empty() {
                    let names: Vec<&str> = changed.iter().map(|one| one.name.as_str()).collect();
                    info!("parameters set: {}", names.join(", "));
                    self.events.publish(ParameterEvent {
                        stamp: self.clock.now(),
                        node: self.node.clone(),
                        changed_parameters: changed,
                        ..ParameterEvent::default()
                    });
                }
                SetParametersResult {
                    successful: true,
                    reason: String::new(),
                }
            }
            Err(reason) => {
                info!("parameters not set: {reason}");
                SetParametersResult {
                    successful: false,
                    reason,
                }
            }
        }
    }
}

/// Answers all six services until the node ends.
pub(crate) fn serve(node: &Node, store: &Arc<ParameterStore>) -> Result<(), NodeError> {
    let setter = Arc::new(Setter {
        store: Arc::clone(store),
        events: node.publisher("/parameter_events", Qos::Event)?,
        node: node.full_name().to_owned(),
        clock: node.clock().clone(),
    });
    let store = || Arc::clone(&setter.store);

    let (server, own) = (
        node.own_service::<GetParameters>("get_parameters")?,
        store(),
    );
    node.spawn(server.serve(move |request| GetParametersResponse {
        values: own.get(&request.names),
    }));
    let (server, own) = (
        node.own_service::<GetParameterTypes>("get_parameter_types")?,
        store(),
    );
    node.spawn(server.serve(move |request| {
        let values = own.get(&request.names);
        let types: Vec<u8> = values.iter().map(|value| value.r#type).collect();
        GetParameterTypesResponse {
            types: types.into(),
        }
    }));
    let (server, own) = (
        node.own_service::<ListParameters>("list_parameters")?,
        store(),
    );
    node.spawn(server.serve(move |request| ListParametersResponse {
        result: own.list(&request),
    }));
    let (server, own) = (
        node.own_service::<DescribeParameters>("describe_parameters")?,
        store(),
    );
    node.spawn(server.serve(move |request| DescribeParametersResponse {
        descriptors: own.describe(&request.names),
    }));
    let (server, own) = (
        node.own_service::<SetParameters>("set_parameters")?,
        Arc::clone(&setter),
    );
    node.spawn(server.serve(move |request| {
        SetParametersResponse {
            results: request
                .parameters
                .iter()
                .map(|parameter| own.set(std::slice::from_ref(parameter)))
                .collect(),
        }
    }));
    let server = node.own_service::<SetParametersAtomically>("set_parameters_atomically")?;
    node.spawn(
        server.serve(move |request| SetParametersAtomicallyResponse {
            result: setter.set(&request.parameters),
        }),
    );
    Ok(())
}
