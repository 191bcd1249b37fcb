//! The page as it is served: as it was built, with its policy in the answer's head, where it also says to whom the page may connect.

/// The element of the page's file that has the policy.
const POLICY: &str = "<meta http-equiv=\"Content-Security-Policy\" content=\"";

/// The page.
pub struct Site {
    page: String,
    policy: String,
}

/// What was given is no page of cantap.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the page has no policy in it; make one with cargo xtask web")]
pub struct SiteError;

impl Site {
    /// The page as `cargo xtask web` builds it, and with what it should open.
    ///
    /// # Errors
    ///
    /// If it is something else.
    pub fn new(page: &str) -> Result<Self, SiteError> {
        let (before, rest) = page.split_once(POLICY).ok_or(SiteError)?;
        let (policy, after) = rest.split_once("\">").ok_or(SiteError)?;
        // It goes into a header.
        if !policy.starts_with("default-src 'none'")
            || policy.contains(|letter: char| !letter.is_ascii_graphic() && letter != ' ')
        {
            return Err(SiteError);
        }
        Ok(Self { page: format!("{before}{after}"), policy: policy.to_owned() })
    }

    /// Its text.
    pub fn page(&self) -> &str {
        &self.page
    }

    /// The header with the policy: the page's own, and connections to `host`, which was checked, alone, in the way in which the page was fetched.
    pub fn policy(&self, host: &str, is_encrypted: bool) -> String {
        let [http, ws] = if is_encrypted { ["https", "wss"] } else { ["http", "ws"] };
        format!(
            "Content-Security-Policy: {}; connect-src {http}://{host} {ws}://{host}; frame-ancestors 'none'\r\n",
            self.policy
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_policy_moves_into_the_head() {
        let page = "<head><meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src 'sha256-x'\"></head>";
        let site = Site::new(page).unwrap();
        assert_eq!(site.page(), "<head></head>");
        assert_eq!(
            site.policy("127.0.0.1:1", false),
            "Content-Security-Policy: default-src 'none'; script-src 'sha256-x'; connect-src http://127.0.0.1:1 ws://127.0.0.1:1; \
             frame-ancestors 'none'\r\n"
        );
        assert!(site.policy("vehicle:1", true).contains("; connect-src https://vehicle:1 wss://vehicle:1; "));
        assert_eq!(Site::new("<html></html>").err(), Some(SiteError));
        let forged = page.replace("'none';", "'none'\r\nX: y;");
        assert_eq!(Site::new(&forged).err(), Some(SiteError));
    }
}
