//! The functions with which scripts let something go wrong on their simulated buses.

use std::rc::Rc;

use cantap_can::Channel;
use rhai::Engine;

use crate::exchange::Output;
use crate::faults::{Fault, Losing};
use crate::runtime::Runtime;
use crate::script_frame::channel_of;
use crate::script_result::Result;
use crate::script_times::{ns, positive_ns};

/// Makes everything known to an engine.
pub fn register(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let happen = {
        let runtime = Rc::clone(runtime);
        move |node: Option<&str>, fault: Fault| -> Result<()> {
            let Some(nodes) = &runtime.surroundings.nodes else {
                return Err("things go wrong on purpose only on simulated buses, and this one is real".into());
            };
            let node = node.map(|name| nodes.find(name, fault)).transpose()?;
            runtime.output(Output::Fault { node, fault })
        }
    };
    let of = happen.clone();
    engine.register_fn("error_burst", move |time: &str| {
        of(None, Fault::ErrorBurst { channel: Channel::Can1, for_ns: positive_ns(time)? })
    });
    let of = happen.clone();
    engine.register_fn("error_burst", move |channel: i64, time: &str| {
        of(None, Fault::ErrorBurst { channel: channel_of(channel)?, for_ns: positive_ns(time)? })
    });
    let of = happen.clone();
    engine.register_fn("bus_off", move |node: &str| of(Some(node), Fault::BusOff { channel: Channel::Can1 }));
    let of = happen.clone();
    engine.register_fn("bus_off", move |channel: i64, node: &str| {
        of(Some(node), Fault::BusOff { channel: channel_of(channel)? })
    });
    let of = happen.clone();
    engine.register_fn("power_off", move |node: &str| of(Some(node), Fault::PowerOff { for_ns: None }));
    let of = happen.clone();
    engine.register_fn("power_off", move |node: &str, time: &str| {
        of(Some(node), Fault::PowerOff { for_ns: Some(ns(time)?) })
    });
    let of = happen.clone();
    engine.register_fn("power_on", move |node: &str| of(Some(node), Fault::PowerOn));
    let of = happen.clone();
    engine.register_fn("stall", move |time: &str| of(None, Fault::Stall { for_ns: positive_ns(time)? }));
    let of = happen.clone();
    engine.register_fn("stall", move |node: &str, time: &str| {
        of(Some(node), Fault::Stall { for_ns: positive_ns(time)? })
    });
    let of = happen.clone();
    engine.register_fn("lose", move |frames: i64| of(None, Fault::Lose(number(frames)?)));
    let of = happen.clone();
    engine.register_fn("lose", move |time: &str| of(None, Fault::Lose(Losing::For(positive_ns(time)?))));
    let of = happen.clone();
    engine.register_fn("lose", move |node: &str, frames: i64| of(Some(node), Fault::Lose(number(frames)?)));
    engine.register_fn("lose", move |node: &str, time: &str| {
        happen(Some(node), Fault::Lose(Losing::For(positive_ns(time)?)))
    });
}

fn number(frames: i64) -> Result<Losing> {
    let frames = u64::try_from(frames).map_err(|_| format!("{frames} frames cannot be lost"))?;
    Ok(Losing::Frames(frames))
}
