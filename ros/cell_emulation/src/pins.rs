//! Digital pins and tool voltage: the service `set_io` and the topic `io_states`.

use msgs::ur_msgs::{Digital, IOStates, SetIORequest};
use simulated_cell::{InvalidOutput, Output, Pins};

/// A request of `set_io` that makes no sense.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InvalidRequest {
    #[error(
        "fun is {0}, expected FUN_SET_DIGITAL_OUT ({digital}), FUN_SET_FLAG ({flag}) or FUN_SET_TOOL_VOLTAGE ({voltage})",
        digital = SetIORequest::FUN_SET_DIGITAL_OUT,
        flag = SetIORequest::FUN_SET_FLAG,
        voltage = SetIORequest::FUN_SET_TOOL_VOLTAGE
    )]
    /// A function that the driver does not have.
    Function(i8),
    #[error(transparent)]
    /// A pin, level or voltage that there is not.
    Output(#[from] InvalidOutput),
}

/// What a request of `set_io` sets.
pub fn output_from_msg(request: &SetIORequest) -> Result<Output, InvalidRequest> {
    let SetIORequest { fun, pin, state } = *request;
    Ok(match fun {
        SetIORequest::FUN_SET_DIGITAL_OUT => Output::digital(pin, state)?,
        SetIORequest::FUN_SET_FLAG => Output::flag(pin, state)?,
        SetIORequest::FUN_SET_TOOL_VOLTAGE => Output::tool_voltage(state)?,
        other => return Err(InvalidRequest::Function(other)),
    })
}

/// Pins and flags as the driver publishes them.
pub fn pins_to_msg(pins: &Pins) -> IOStates {
    let digital = |(pin, state): (&u8, &bool)| Digital {
        pin: *pin,
        state: *state,
    };
    IOStates {
        digital_in_states: pins.inputs.iter().map(digital).collect(),
        digital_out_states: pins.outputs.iter().map(digital).collect(),
        flag_states: pins.flags.iter().map(digital).collect(),
        ..Default::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_request_to_the_pins_is_read_and_one_without_sense_is_refused_by_its_field() {
        let request = |fun, pin, state| output_from_msg(&SetIORequest { fun, pin, state });
        let digital = SetIORequest::FUN_SET_DIGITAL_OUT;
        let on = Output::Digital {
            pin: 16,
            level: true,
        };
        assert_eq!(request(digital, 16, 1.0), Ok(on));
        let voltage = request(SetIORequest::FUN_SET_TOOL_VOLTAGE, 0, 24.0);
        assert_eq!(voltage, Ok(Output::ToolVoltage(24)));
        let error = |fun, pin| request(fun, pin, 1.0).unwrap_err().to_string();
        assert_eq!(error(digital, 18), "pin is 18, expected 0 to 17");
        assert!(error(3, 0).starts_with("fun is 3, expected FUN_SET_DIGITAL_OUT (1)"));
    }
}
