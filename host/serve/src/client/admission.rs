//! Lets a client in, and starts the two threads that serve it.

use std::io::{Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use cantap_wire::message::Role;

use super::{Client, Identity};
use crate::lock::lock;
use crate::news::News;
use crate::outbox::Outbox;
use crate::places::Place;
use crate::shared::{Refused, Shared};
use crate::state::Member;
use crate::stream::{View, Views};
use crate::writer;

/// Who comes.
pub struct Guest {
    /// Its name in messages.
    pub name: String,
    /// The most that it may do.
    pub role: Role,
    /// Its place at its listener, to be given back when it leaves.
    pub place: Option<Place>,
    /// It takes one of the board's places, because it has none at a listener.
    pub is_counted: bool,
    /// It is at the other end of a line that can break without notice.
    pub is_remote: bool,
    /// Who it is, if it has shown a certificate.
    pub identity: Option<Identity>,
}

impl Guest {
    /// A client on this machine that has no place at a listener.
    pub fn of_board(name: &str, role: Role) -> Self {
        Self { name: name.to_owned(), role, place: None, is_counted: true, is_remote: false, identity: None }
    }
}

/// Admits a client. Two separate threads serve it until either side ends.
pub fn admit(
    shared: &Arc<Shared>,
    mut input: Box<dyn Read + Send>,
    mut output: Box<dyn Write + Send>,
    guest: Guest,
) -> Result<(), Refused> {
    let Guest { name, role, place, is_counted, is_remote, identity } = guest;
    let permit = match &identity {
        None => None,
        Some(identity) => shared.permit_of(&identity.certificate).map_err(Refused::NotPermitted)?,
    };
    let budget =
        identity.as_ref().map(|identity| shared.budget_of(&identity.certificate)).unwrap_or_default();
    let role = permit.as_ref().map_or(role, |(permit, _)| permit.role(role));
    let id = shared.next_client();
    let outbox = Arc::new(Outbox::new(shared.settings.most_records));
    {
        let mut state = shared.state();
        if state.is_over {
            return Err(Refused::Over);
        }
        let counted = state.clients.values().filter(|member| member.is_counted).count();
        if is_counted && counted >= shared.settings.most_clients {
            return Err(Refused::TooMany(counted));
        }
        let member = Member {
            is_counted,
            role,
            outbox: Arc::clone(&outbox),
            in_session: false,
            views: Views::default(),
            counts: Default::default(),
        };
        state.clients.insert(id, member);
        state.writers += 1;
    }
    let has_greeted = Arc::new(AtomicBool::new(false));
    let client = Client {
        shared: Arc::clone(shared),
        id,
        role,
        name: name.clone(),
        dead_man: shared.settings.dead_man.filter(|_| is_remote),
        identity,
        permit,
        budget,
        sent: Mutex::default(),
        place,
        has_greeted: Arc::clone(&has_greeted),
        let_go: Arc::default(),
        outbox: Arc::clone(&outbox),
    };
    let let_go = Arc::clone(&client.let_go);
    let leave = |error| {
        shared.state().remove(id);
        Refused::Thread(error)
    };
    let told = Arc::clone(shared);
    let for_writer = Arc::clone(&outbox);
    std::thread::Builder::new()
        .name("cantap-to-client".to_owned())
        .spawn(move || {
            let patience = || {
                let state = told.state();
                let sends =
                    state.clients.get(&id).is_some_and(|member| member.views.iter().any(View::transmits));
                if sends { writer::SENDER_PATIENCE } else { writer::PATIENCE }
            };
            let failed = writer::run(&for_writer, &mut *output, id, &patience).err();
            for_writer.abandon();
            let reason = lock(&let_go).take();
            if has_greeted.load(Ordering::Relaxed) {
                told.tell(News::ClientLeft { client: name, reason: reason.or(failed) });
            } else if let Some(reason) = reason {
                told.tell(News::Refused { client: name, reason });
            }
            told.has_written();
        })
        .map_err(|error| {
            shared.has_written();
            leave(error)
        })?;
    std::thread::Builder::new()
        .name("cantap-client".to_owned())
        .spawn(move || {
            client.serve(&mut *input);
            client.leave();
        })
        .map_err(|error| {
            outbox.close();
            leave(error)
        })?;
    Ok(())
}
