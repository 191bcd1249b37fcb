//! Why a picture could not be made.

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlotError {
    /// The name does not indicate the format.
    #[error("'{0}' names no picture format; use .svg, .png or .html")]
    UnknownFormat(String),
    /// The picture is too large, or too small, for PNG.
    #[error("a picture of {width} × {height} pixels cannot be drawn; choose another size")]
    Size {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// PNG encoding failed.
    #[error("cannot encode the picture as PNG: {0}")]
    Png(String),
    /// The file cannot be written.
    #[error("cannot write {0}: {1}; check folder, rights and free space")]
    Write(String, #[source] std::io::Error),
}
