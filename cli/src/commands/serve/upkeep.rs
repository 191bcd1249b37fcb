//! What goes on beside serving: the permissions, the audit log, and reading files again when a hang-up asks for it (SIGHUP).

use std::path::Path;
#[cfg(feature = "tls")]
use std::path::PathBuf;
use std::sync::{Arc, Weak};

use anyhow::Context;
use cantap_serve::Board;
use cantap_serve::audit::Audit;
#[cfg(feature = "tls")]
use cantap_serve::permissions::{Permissions, PermissionsError};
#[cfg(feature = "tls")]
use cantap_serve::tls::Server;
#[cfg(unix)]
use nix::sys::signal::{SigSet, Signal};

use crate::stderr;

/// Prepared before there are boards.
pub struct Upkeep {
    files: Reread,
    audit: Option<Arc<Audit>>,
    #[cfg(unix)]
    hang_ups: Option<SigSet>,
}

/// What is read again.
#[derive(Default)]
struct Reread {
    boards: Vec<Weak<Board>>,
    #[cfg(feature = "tls")]
    permissions: Option<PathBuf>,
    #[cfg(feature = "tls")]
    server: Option<Server>,
}

impl Upkeep {
    /// Reads the file of permissions, which are those of certificates, and begins the one of the audit, so that a mistake is known before there
    /// is a server. From now on, a hang-up does not end the program if there is something to read again. Threads that exist already are not
    /// affected, so this comes before the first.
    pub fn new(permissions: Option<&Path>, audit: Option<&Path>, is_encrypted: bool) -> anyhow::Result<Self> {
        #[cfg(unix)]
        let hang_ups = (is_encrypted || permissions.is_some()).then(|| {
            let mut signals = SigSet::empty();
            signals.add(Signal::SIGHUP);
            signals.thread_block().map(|()| signals)
        });
        // Elsewhere there are no hang-ups, nor files to read again.
        #[cfg(not(unix))]
        let _ = (permissions, is_encrypted);
        #[cfg(feature = "tls")]
        if let Some(path) = permissions {
            Permissions::read(path)?;
        }
        let audit = audit.map(|path| {
            Audit::open(path, |trouble| stderr::warn(&trouble)).with_context(|| {
                format!("nothing can be recorded in '{}'; give another file with --audit", path.display())
            })
        });
        Ok(Self {
            files: Reread {
                #[cfg(feature = "tls")]
                permissions: permissions.map(Path::to_owned),
                ..Reread::default()
            },
            audit: audit.transpose()?.map(Arc::new),
            #[cfg(unix)]
            hang_ups: hang_ups.transpose()?,
        })
    }

    /// Applies the permissions and begins to record. Ends with the program.
    pub fn begin(
        &mut self,
        boards: &[Arc<Board>],
        #[cfg(feature = "tls")] server: Option<Server>,
    ) -> anyhow::Result<()> {
        let mut files = std::mem::take(&mut self.files);
        files.boards = boards.iter().map(Arc::downgrade).collect();
        #[cfg(feature = "tls")]
        {
            files.server = server;
        }
        #[cfg(feature = "tls")]
        files.permit(files.read_permissions()?.as_ref());
        if let Some(audit) = &self.audit {
            for board in boards {
                board.record_to(Arc::clone(audit));
            }
        }
        #[cfg(unix)]
        if let Some(signals) = self.hang_ups.take() {
            std::thread::Builder::new().name("cantap-hang-ups".to_owned()).spawn(move || {
                while signals.wait().is_ok() {
                    files.read_again();
                }
            })?;
        }
        Ok(())
    }

    /// Waits for what is recorded.
    pub fn finish(self) {
        if let Some(audit) = self.audit {
            audit.finish();
        }
    }
}

impl Reread {
    /// The permissions as they are in their file now, if there is one.
    #[cfg(feature = "tls")]
    fn read_permissions(&self) -> Result<Option<Arc<Permissions>>, PermissionsError> {
        Ok(self.permissions.as_deref().map(Permissions::read).transpose()?.map(Arc::new))
    }

    /// Applies permissions.
    #[cfg(feature = "tls")]
    fn permit(&self, permissions: Option<&Arc<Permissions>>) {
        let Some(permissions) = permissions else { return };
        for (number, board) in self.boards.iter().enumerate() {
            if let Some(board) = board.upgrade() {
                board.permit_only(Arc::clone(permissions), number);
            }
        }
    }

    /// Everything is read before anything changes: half of the old and half of the new may let somebody do what neither does.
    #[cfg(unix)]
    fn read_again(&self) {
        #[cfg(feature = "tls")]
        {
            let read = || -> anyhow::Result<_> {
                let permissions = self.read_permissions()?;
                Ok((permissions, self.server.as_ref().map(Server::read_again).transpose()?))
            };
            match read() {
                Ok((permissions, server)) => {
                    self.permit(permissions.as_ref());
                    server.into_iter().for_each(cantap_serve::tls::Reread::apply);
                }
                Err(error) => {
                    stderr::warn(&format!("{error}; the permissions and certificates all stay as they were"));
                    return;
                }
            }
        }
        stderr::tell("cantap: the permissions and certificates were read again\n");
    }
}
