//! Job control by the shell and by other programs.

#[cfg(unix)]
use std::sync::Arc;

/// Whether another program asked this one to stop for a while (SIGTSTP), as a shell's job control does.
pub struct Stops {
    #[cfg(unix)]
    asked: Arc<std::sync::atomic::AtomicBool>,
}

impl Stops {
    /// Begins to take note of it.
    #[cfg(unix)]
    pub fn watch() -> std::io::Result<Self> {
        let asked = Arc::default();
        signal_hook::flag::register(signal_hook::consts::SIGTSTP, Arc::clone(&asked))?;
        Ok(Self { asked })
    }

    /// Whether it was asked since the last call.
    #[cfg(unix)]
    pub fn asked(&self) -> bool {
        self.asked.swap(false, std::sync::atomic::Ordering::Relaxed)
    }

    #[cfg(not(unix))]
    #[expect(clippy::unnecessary_wraps, reason = "it can fail where there are signals")]
    pub fn watch() -> std::io::Result<Self> {
        Ok(Self {})
    }

    #[cfg(not(unix))]
    #[expect(clippy::unused_self, reason = "there are no such signals here")]
    pub fn asked(&self) -> bool {
        false
    }
}
