//! The functions that scripts call.

use std::rc::Rc;

use cantap_can::{Channel, Frame, Id};
use cantap_protocols::active::exchange::{Answerer, Exchange, ResponseTiming};
use cantap_protocols::active::transfer::TransferSettings;
use cantap_protocols::iso_tp::Endpoint;
use cantap_signals::encode;
use cantap_trace::counted;
use cantap_trace::grammar::{self, IdPattern};
use rhai::{Array, Blob, Dynamic, Engine, FnPtr, Map, NativeCallContext};

use crate::byte_functions::byte;
use crate::exchange::Output;
use crate::handlers::{Repeated, Selector};
use crate::runtime::Runtime;
use crate::script_frame::{ScriptFrame, channel_of};
use crate::script_result::Result;
use crate::script_times::{ns, positive_ns};

/// A repetition that a script can change and end.
#[derive(Clone, Copy, Debug)]
struct Repetition {
    handle: u32,
    channel: Channel,
    frame: Frame,
    period_ns: u64,
}

/// Something that a script reacts to, and can end.
#[derive(Clone, Copy, Debug)]
struct Handle(u32);

/// Makes everything known to an engine.
pub fn register(engine: &mut Engine, runtime: &Rc<Runtime>) {
    crate::script_frame::register(engine);
    crate::byte_functions::register(engine);
    engine.register_type_with_name::<Repetition>("Repetition").register_type_with_name::<Handle>("Handle");
    sending(engine, runtime);
    reacting(engine, runtime);
    waiting(engine, runtime);
    values(engine, runtime);
    verdicts(engine, runtime);
    crate::server_functions::register(engine, runtime);
    crate::fault_functions::register(engine, runtime);
    crate::file_functions::register(engine, runtime);
    crate::step_functions::register(engine, runtime);
    crate::test_functions::register(engine, runtime);
}

fn sending(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let frame_of = |text: &str| ScriptFrame::parse(text).map_err(Into::into);
    engine.register_fn("frame", move |text: &str| -> Result<ScriptFrame> { frame_of(text) });
    engine.register_fn("frame", |id: i64, data: Blob| make_frame(numbered(id)?, &data));
    engine.register_fn("frame", |id: i64, data: Array| make_frame(numbered(id)?, &bytes_of(&data)?));
    engine.register_fn("frame", |id: &str, data: Blob| make_frame(grammar::identifier(id)?, &data));
    engine.register_fn("frame", |id: &str, data: Array| {
        make_frame(grammar::identifier(id)?, &bytes_of(&data)?)
    });

    let send = {
        let runtime = Rc::clone(runtime);
        move |channel: i64, frame: Frame| -> Result<()> {
            runtime.output(Output::Send { channel: channel_of(channel)?, frame })
        }
    };
    let one = send.clone();
    engine.register_fn("send", move |text: &str| one(1, ScriptFrame::parse(text)?.frame));
    let one = send.clone();
    engine.register_fn("send", move |channel: i64, text: &str| one(channel, ScriptFrame::parse(text)?.frame));
    let one = send.clone();
    engine.register_fn("send", move |frame: ScriptFrame| one(1, frame.frame));
    let one = send.clone();
    engine.register_fn("send", move |channel: i64, frame: ScriptFrame| one(channel, frame.frame));

    let of = Rc::clone(runtime);
    let message_frame = move |channel: i64, name: &str, signals: &Map| -> Result<Frame> {
        encoded(&of, channel, name, signals)
    };
    let make = message_frame.clone();
    engine.register_fn("message", move |name: &str, signals: Map| -> Result<ScriptFrame> {
        Ok(ScriptFrame::new(make(1, name, &signals)?))
    });
    let (make, one) = (message_frame.clone(), send.clone());
    engine.register_fn("send", move |name: &str, signals: Map| one(1, make(1, name, &signals)?));
    engine.register_fn("send", move |channel: i64, name: &str, signals: Map| {
        send(channel, message_frame(channel, name, &signals)?)
    });

    let repeat = {
        let runtime = Rc::clone(runtime);
        move |channel: i64, frame: Frame, period: &str| -> Result<Repetition> {
            let handle = runtime.with_handlers(super::handlers::Handlers::new_handle);
            let period_ns = positive_ns(period)?;
            let repetition = Repetition { handle, channel: channel_of(channel)?, frame, period_ns };
            runtime.output(repetition.output())?;
            Ok(repetition)
        }
    };
    let every = repeat.clone();
    engine.register_fn("periodic", move |text: &str, period: &str| {
        every(1, ScriptFrame::parse(text)?.frame, period)
    });
    let every = repeat.clone();
    engine.register_fn("periodic", move |frame: ScriptFrame, period: &str| every(1, frame.frame, period));
    engine.register_fn("periodic", move |channel: i64, frame: ScriptFrame, period: &str| {
        repeat(channel, frame.frame, period)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("change", move |repetition: &mut Repetition, frame: ScriptFrame| {
        repetition.frame = frame.frame;
        of.output(repetition.output())
    });
    let of = Rc::clone(runtime);
    engine.register_fn("stop", move |repetition: Repetition| {
        of.output(Output::EndRepeat { handle: repetition.handle })
    });
}

fn reacting(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let of = Rc::clone(runtime);
    engine.register_fn("on_frame", move |ids: &str, call: FnPtr| -> Result<Handle> {
        let selector = selector(&of, ids)?;
        of.on_frame(selector, call).map(Handle)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("on_frame", move |call: FnPtr| of.on_frame(Selector::All, call).map(Handle));
    let of = Rc::clone(runtime);
    engine.register_fn("on_message", move |name: &str, call: FnPtr| -> Result<Handle> {
        let selector = message_selector(&of, name)?;
        of.react(|handlers| handlers.on_frame(selector, call)).map(Handle)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("on_error", move |call: FnPtr| of.react(|handlers| handlers.on_error(call)));
    let of = Rc::clone(runtime);
    engine.register_fn("on_state", move |call: FnPtr| of.react(|handlers| handlers.on_state(call)));
    let of = Rc::clone(runtime);
    engine.register_fn("on_key", move |key: char, call: FnPtr| {
        of.react(|handlers| handlers.on_key(Some(key), call)).map(Handle)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("on_key", move |key: &str, call: FnPtr| -> Result<Handle> {
        let mut characters = key.chars();
        let (Some(key), None) = (characters.next(), characters.next()) else {
            return Err(format!("{key:?} is not one key; write it as in on_key(\"a\", || …)").into());
        };
        of.react(|handlers| handlers.on_key(Some(key), call)).map(Handle)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("on_key", move |call: FnPtr| {
        of.react(|handlers| handlers.on_key(None, call)).map(Handle)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("every", move |period: &str, call: FnPtr| -> Result<Handle> {
        let period_ns = positive_ns(period)?;
        of.after(period_ns, Some(Repeated::exactly(period_ns)), call).map(Handle)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("every", move |period: &str, jitter: &str, call: FnPtr| -> Result<Handle> {
        let (period_ns, jitter_ns) = (positive_ns(period)?, ns(jitter)?);
        if jitter_ns >= period_ns {
            return Err(format!("a jitter of {jitter} is not less than the period, {period}").into());
        }
        of.after(period_ns, Some(Repeated { period_ns, jitter_ns }), call).map(Handle)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("after", move |delay: &str, call: FnPtr| -> Result<Handle> {
        of.after(ns(delay)?, None, call).map(Handle)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("stop", move |handle: Handle| of.end_reaction(handle.0));
}

fn waiting(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let of = Rc::clone(runtime);
    engine.register_fn("now", move || of.now_ns() as f64 / 1e9);
    let of = Rc::clone(runtime);
    engine.register_fn("wait", move |context: NativeCallContext<'_>, delay: &str| {
        of.wait(&context, of.now_ns() + ns(delay)?)
    });
    let of = Rc::clone(runtime);
    engine.register_fn("wait_for", move |context: NativeCallContext<'_>, ids: &str, within: &str| {
        let found = of.wait_for(&context, of.now_ns() + ns(within)?, &selector(&of, ids)?)?;
        Ok::<Dynamic, Box<rhai::EvalAltResult>>(found.map_or(Dynamic::UNIT, Dynamic::from))
    });
    let of = Rc::clone(runtime);
    engine.register_fn("expect", move |context: NativeCallContext<'_>, ids: &str, within: &str| {
        let found = of.wait_for(&context, of.now_ns() + ns(within)?, &selector(&of, ids)?)?;
        let missing = || Box::<rhai::EvalAltResult>::from(format!("no frame {ids} within {within}"));
        found.ok_or_else(missing)
    });
    let of = Rc::clone(runtime);
    engine.register_fn(
        "expect",
        move |context: NativeCallContext<'_>,
              ids: &str,
              within: &str,
              is_wanted: FnPtr|
              -> Result<ScriptFrame> {
            let until_ns = of.now_ns() + ns(within)?;
            let selector = selector(&of, ids)?;
            while let Some(frame) = of.wait_for(&context, until_ns, &selector)? {
                if is_wanted.call_within_context::<bool>(&context, (frame,))? {
                    return Ok(frame);
                }
            }
            Err(format!("no frame {ids} of the kind that is expected within {within}").into())
        },
    );
    let of = Rc::clone(runtime);
    engine.register_fn("serve", move |context: NativeCallContext<'_>| of.serve(&context));
    let of = Rc::clone(runtime);
    engine.register_fn(
        "request",
        move |context: NativeCallContext<'_>, request: &str, response: &str, data: Array| -> Result<Blob> {
            let ids = (grammar::identifier(request)?, grammar::identifier(response)?);
            ask(&of, &context, ids, &bytes_of(&data)?)
        },
    );
}

fn values(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let of = Rc::clone(runtime);
    engine.register_fn("signals", move |frame: ScriptFrame| of.decode(&frame));
    let of = Rc::clone(runtime);
    engine.register_fn("value", move |name: &str| -> Result<Dynamic> {
        let (message, signal) = name.rsplit_once('.').ok_or("write it as Message.Signal")?;
        let found = of.surroundings.decoder.messages().find(|(_, _, candidate)| candidate.name == message);
        let Some((_, _, found)) = found else { return Err(unknown_message(&of, message).into()) };
        if !found.signals.iter().any(|candidate| candidate.label() == signal) {
            return Err(format!("message {message} has no signal {signal}").into());
        }
        Ok(of.value(name).unwrap_or(Dynamic::UNIT))
    });
    let of = Rc::clone(runtime);
    engine.register_fn("random", move |from: i64, to: i64| -> Result<i64> {
        if from > to {
            return Err(format!("random({from}, {to}): the first must not be larger than the second").into());
        }
        Ok(of.with_random(|random| random.i64(from..=to)))
    });
}

fn verdicts(engine: &mut Engine, runtime: &Rc<Runtime>) {
    let of = Rc::clone(runtime);
    let log = move |text: &str| {
        // Only frames can be refused.
        let _ = of.output(Output::Log(text.to_owned()));
    };
    let print = log.clone();
    engine.on_print(move |text| print(text));
    let print = log.clone();
    engine.on_debug(move |text, _, _| print(text));
    let print = log.clone();
    engine.register_fn("log", move |value: Dynamic| print(&value.to_string()));
    // For a number, the language has a logarithm of this name.
    engine.register_fn("log", move |value: f64| log(&value.to_string()));
    engine.register_fn("fail", |reason: &str| -> Result<()> { Err(reason.into()) });
    engine.register_fn("check", |is_so: bool, what: &str| -> Result<()> {
        if is_so { Ok(()) } else { Err(format!("not so: {what}").into()) }
    });
}

impl Repetition {
    const fn output(self) -> Output {
        let Self { handle, channel, frame, period_ns } = self;
        Output::Repeat { handle, channel, frame, period_ns }
    }
}

/// Asks a server over ISO-TP, as testers do; a negative response is an error.
fn ask(
    runtime: &Runtime,
    context: &NativeCallContext<'_>,
    (request, response): (Id, Id),
    data: &[u8],
) -> Result<Blob> {
    if data.is_empty() {
        return Err("a request has at least one byte".into());
    }
    let [to, from] = [request, response].map(|id| Endpoint { id, address: None });
    let answerer = Answerer::One { from, flow_to: to };
    let mut exchange =
        Exchange::new(to, answerer, data.to_vec(), TransferSettings::default(), ResponseTiming::default());
    runtime.run_client(context, Channel::Can1, &mut exchange)?;
    let (answers, broken) = exchange.finish().map_err(|error| error.to_string())?;
    if let Some((_, error)) = broken.first() {
        return Err(format!("the response broke off: {error}").into());
    }
    let answer = answers.into_iter().next().ok_or("there was no response")?;
    match answer.refusal() {
        Some(code) => Err(format!("negative response {code:02X}").into()),
        None => Ok(answer.data),
    }
}

/// An identifier from a number.
fn numbered(id: i64) -> Result<Id> {
    let raw = u32::try_from(id).map_err(|_| format!("{id} is no identifier"))?;
    let id = Id::standard(raw).or_else(|| Id::extended(raw));
    id.ok_or_else(|| format!("0x{raw:X} has more than 29 bits").into())
}

fn make_frame(id: Id, data: &[u8]) -> Result<ScriptFrame> {
    let frame = Frame::data_frame(id, data)
        .ok_or_else(|| format!("{}; a frame carries 8", counted(data.len(), "byte")))?;
    Ok(ScriptFrame::new(frame))
}

fn bytes_of(values: &Array) -> Result<Vec<u8>> {
    let number =
        |value: &Dynamic| -> Result<i64> { value.as_int().map_err(|_| format!("{value} is no byte").into()) };
    values.iter().map(|value| byte(number(value)?)).collect()
}

/// Identifiers in the grammar of every command, or a message's name.
fn selector(runtime: &Runtime, text: &str) -> Result<Selector> {
    match text.parse::<IdPattern>() {
        Ok(ids) => Ok(Selector::Ids { channel: None, ids }),
        Err(error) => message_selector(runtime, text).map_err(|_| error.to_string().into()),
    }
}

fn message_selector(runtime: &Runtime, name: &str) -> Result<Selector> {
    let found = runtime.surroundings.decoder.messages().find(|(_, _, message)| message.name == name);
    found
        .map(|(reference, _, _)| Selector::Message(reference))
        .ok_or_else(|| unknown_message(runtime, name).into())
}

fn unknown_message(runtime: &Runtime, name: &str) -> String {
    if runtime.surroundings.decoder.messages().next().is_none() {
        return format!("there is no message {name}: give a database with --db");
    }
    // The database's own words for a name that is nearly one of its own.
    match encode::encode(&runtime.surroundings.decoder, None, name) {
        Err(error) => error.to_string(),
        Ok(_) => format!("there is no message {name}"),
    }
}

/// A message's frame from values, or the texts of value tables.
fn encoded(runtime: &Runtime, channel: i64, name: &str, signals: &Map) -> Result<Frame> {
    let channel = channel_of(channel)?;
    if runtime.surroundings.decoder.messages().next().is_none() {
        return Err(unknown_message(runtime, name).into());
    }
    let values: Vec<String> = signals.iter().map(|(signal, value)| format!("{signal}={value}")).collect();
    let text = if values.is_empty() { name.to_owned() } else { format!("{name}:{}", values.join(",")) };
    let encoded = encode::encode(&runtime.surroundings.decoder, Some(channel.number()), &text);
    encoded.map(|encoded| encoded.frame).map_err(|error| error.to_string().into())
}
