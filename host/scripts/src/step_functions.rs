//! Steps with waits and jumps, as the earlier analysers' scripts were.

use std::rc::Rc;

use cantap_can::{Channel, Frame};
use rhai::{Array, Dynamic, Engine, FnPtr, Map, NativeCallContext};

use crate::exchange::Output;
use crate::runtime::Runtime;
use crate::script_frame::{ScriptFrame, channel_of};
use crate::script_result::Result;
use crate::script_times::ns;

/// Jumps while no time passes: more are a circle that never ends.
const MOST_JUMPS: u32 = 1000;
/// What a jump costs in operations.
const JUMP_COST: usize = 64;
/// What a step can have.
const KEYS: [&str; 7] = ["name", "channel", "send", "run", "wait", "jump", "times"];

/// What is done in this order.
struct Step {
    send: Option<(Channel, Frame)>,
    run: Option<FnPtr>,
    wait_ns: Option<u64>,
    jump: Option<Jump>,
}

/// A jump to a step, so many times in a row, or each time.
struct Jump {
    to: usize,
    times: Option<u32>,
    done: u32,
}

/// Makes everything known to an engine.
pub fn register(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let of = Rc::clone(runtime);
    engine.register_fn("play", move |context: NativeCallContext<'_>, steps: Array| {
        play(&of, &context, &mut read(&steps)?)
    });
}

fn play(runtime: &Runtime, context: &NativeCallContext<'_>, steps: &mut [Step]) -> Result<()> {
    let (mut at, mut jumps, mut jumped_ns) = (0, 0, runtime.now_ns());
    while let Some(step) = steps.get_mut(at) {
        at += 1;
        if let Some((channel, frame)) = step.send {
            runtime.output(Output::Send { channel, frame })?;
        }
        if let Some(run) = &step.run {
            let _ = run.call_within_context::<Dynamic>(context, ())?;
        }
        if let Some(wait_ns) = step.wait_ns {
            runtime.wait(context, runtime.now_ns().saturating_add(wait_ns))?;
        }
        let Some(jump) = &mut step.jump else { continue };
        if jump.times.is_some_and(|times| jump.done >= times) {
            jump.done = 0;
            continue;
        }
        jump.done = jump.done.saturating_add(1);
        at = jump.to;
        runtime.spend(JUMP_COST);
        if runtime.now_ns() != jumped_ns {
            (jumps, jumped_ns) = (0, runtime.now_ns());
        }
        jumps += 1;
        if jumps > MOST_JUMPS {
            return Err(
                format!("more than {MOST_JUMPS} jumps while no time passed; give a step a wait").into()
            );
        }
    }
    Ok(())
}

fn read(steps: &Array) -> Result<Vec<Step>> {
    let maps = steps.iter().map(|step| step.clone().try_cast::<Map>());
    let maps: Vec<Map> =
        maps.collect::<Option<_>>().ok_or("a step is a map such as #{ send: \"123#\", wait: \"10ms\" }")?;
    let name = |map: &Map| map.get("name").map(ToString::to_string);
    let names: Vec<Option<String>> = maps.iter().map(name).collect();
    if let Some(twice) =
        (0..names.len()).find(|at| names[*at].is_some() && names[..*at].contains(&names[*at]))
    {
        return Err(format!("two steps have the name {}", names[twice].as_deref().unwrap_or_default()).into());
    }
    maps.iter().map(|map| step(map, &names)).collect()
}

fn step(map: &Map, names: &[Option<String>]) -> Result<Step> {
    if let Some(key) = map.keys().find(|key| !KEYS.contains(&key.as_str())) {
        return Err(format!("a step has no {key}; it has {}", KEYS.join(", ")).into());
    }
    let text = |key: &str| map.get(key).map(ToString::to_string);
    let number = |key: &str| {
        let number = map.get(key).map(|value| value.as_int().map_err(|_| format!("{key} is a whole number")));
        number.transpose()
    };
    let channel = number("channel")?.map_or(Ok(Channel::Can1), channel_of)?;
    let send = match map.get("send") {
        Some(frame) if frame.is::<ScriptFrame>() => frame.clone().try_cast::<ScriptFrame>(),
        Some(text) => Some(ScriptFrame::parse(&text.to_string())?),
        None => None,
    };
    let run = match map.get("run") {
        Some(run) => Some(run.clone().try_cast::<FnPtr>().ok_or("run is a function, as in run: || log(1)")?),
        None => None,
    };
    let times = match number("times")? {
        Some(times) => Some(u32::try_from(times).map_err(|_| format!("a step cannot jump {times} times"))?),
        None => None,
    };
    let jump = match text("jump") {
        Some(to) => {
            let found = names.iter().position(|name| name.as_deref() == Some(to.as_str()));
            let to = found.ok_or_else(|| format!("there is no step {to:?} to jump to"))?;
            Some(Jump { to, times, done: 0 })
        }
        None if times.is_some() => return Err("times is for a jump, and this step has none".into()),
        None => None,
    };
    let wait_ns = text("wait").map(|time| ns(&time)).transpose()?;
    Ok(Step { send: send.map(|frame| (channel, frame.frame)), run, wait_ns, jump })
}
