//! DDS security by the settings of ROS 2: `ROS_SECURITY_ENABLE`, `ROS_SECURITY_STRATEGY`, `ROS_SECURITY_KEYSTORE`,
//! `ROS_SECURITY_ENCLAVE_OVERRIDE` and `--enclave`.

use std::{
    fs::File,
    path::{Path, PathBuf},
};

use tracing::warn;

/// What an enclave has, by the names of `ros2 security`.
const FILES: [&str; 6] = [
    "identity_ca.cert.pem",
    "cert.pem",
    "key.pem",
    "permissions_ca.cert.pem",
    "governance.p7s",
    "permissions.p7s",
];

/// A list of certificates that count no longer. RustDDS does not read it.
const REVOCATION_LIST: &str = "crl.pem";

/// Which files a node's participant is protected with.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Security {
    /// Whether a node without files is refused (`Enforce`), or starts unprotected (`Permissive`).
    enforce: bool,
    keystore: Option<PathBuf>,
    /// In place of what `--enclave` says.
    enclave: Option<String>,
}

/// What is wrong with the files of an enclave.
#[derive(Debug, thiserror::Error)]
pub enum SecurityError {
    /// An environment variable makes no sense.
    #[error("environment variable {name}={value}: expected {expected}")]
    Variable {
        /// Its name.
        name: &'static str,
        /// Its value.
        value: String,
        /// What it may be.
        expected: &'static str,
    },
    /// ROS_SECURITY_KEYSTORE is not set.
    #[error(
        "ROS_SECURITY_KEYSTORE is not set: expected the folder that `ros2 security create_keystore` made"
    )]
    NoKeystore,
    /// An enclave has to be an absolute name.
    #[error(
        "enclave {0:?}: expected an absolute name of letters, digits and underscores, as in --enclave /sctn/suction_executor"
    )]
    EnclaveName(String),
    /// One of the files is missing or cannot be read.
    #[error("{}: {reason}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The executable was built without the feature `security`.
    #[error("ROS_SECURITY_ENABLE=true: this program was built without the feature `security`")]
    NotBuilt,
}

impl Security {
    /// Nothing where security is off.
    pub(crate) fn from_variables(
        read: impl Fn(&str) -> Option<String>,
    ) -> Result<Option<Self>, SecurityError> {
        let set = |name| read(name).filter(|value| !value.is_empty());
        let bad = |name, value: &str, expected| {
            Err(SecurityError::Variable {
                name,
                value: value.to_owned(),
                expected,
            })
        };
        // rcl takes every other word for false: nobody means that.
        match set("ROS_SECURITY_ENABLE").as_deref() {
            Some("true") => {}
            None | Some("false") => return Ok(None),
            Some(other) => return bad("ROS_SECURITY_ENABLE", other, "true or false"),
        }
        if cfg!(not(feature = "security")) {
            return Err(SecurityError::NotBuilt);
        }
        let enforce = match set("ROS_SECURITY_STRATEGY").as_deref() {
            Some("Enforce") => true,
            None | Some("Permissive") => false,
            Some(other) => {
                return bad("ROS_SECURITY_STRATEGY", other, "Enforce or Permissive");
            }
        };
        Ok(Some(Self {
            enforce,
            keystore: set("ROS_SECURITY_KEYSTORE").map(PathBuf::from),
            enclave: set("ROS_SECURITY_ENCLAVE_OVERRIDE"),
        }))
    }

    /// The folder of an enclave's files. Nothing where there are none and the strategy allows that: as rcl does, a
    /// node starts unprotected then, and says so.
    pub(crate) fn enclave(&self, name: Option<&str>) -> Result<Option<PathBuf>, SecurityError> {
        let name = self.enclave.as_deref().or(name).unwrap_or("/");
        match self.complete_enclave(name) {
            Ok(folder) => Ok(Some(folder)),
            Err(error @ (SecurityError::NoKeystore | SecurityError::File { .. }))
                if !self.enforce =>
            {
                warn!("ROS_SECURITY_STRATEGY is not Enforce: this node is NOT protected. {error}");
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    fn complete_enclave(&self, name: &str) -> Result<PathBuf, SecurityError> {
        let relative = name.strip_prefix('/').filter(|relative| {
            let is_word = |word: &str| {
                let characters = word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
                !word.is_empty() && characters && !word.starts_with(|c: char| c.is_ascii_digit())
            };
            relative.is_empty() || relative.split('/').all(is_word)
        });
        let relative = relative.ok_or_else(|| SecurityError::EnclaveName(name.to_owned()))?;
        let keystore = self.keystore.as_ref().ok_or(SecurityError::NoKeystore)?;
        let folder = keystore.join("enclaves").join(relative);
        for file in FILES {
            let path = folder.join(file);
            if let Err(error) = File::open(&path) {
                let reason = format!("{error}; enclave {name} has to have it");
                return Err(SecurityError::File { path, reason });
            }
        }
        Ok(folder)
    }
}

/// Refuses what the files of an enclave ask for and RustDDS does not do.
pub(crate) fn check_supported(folder: &Path) -> Result<(), SecurityError> {
    let path = folder.join(REVOCATION_LIST);
    if path.exists() {
        let reason = "lists of revoked certificates are not supported: a certificate on it would still count. \
                      Make a new keystore without those certificates";
        return Err(SecurityError::File {
            path,
            reason: reason.to_owned(),
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn security(variables: &[(&str, &str)]) -> Result<Option<Security>, SecurityError> {
        Security::from_variables(|name| {
            variables
                .iter()
                .find(|(key, _)| *key == name)
                .map(|(_, value)| (*value).to_owned())
        })
    }

    fn keystore(strategy: &str, folder: &Path) -> Security {
        security(&[
            ("ROS_SECURITY_ENABLE", "true"),
            ("ROS_SECURITY_STRATEGY", strategy),
            ("ROS_SECURITY_KEYSTORE", folder.to_str().unwrap()),
        ])
        .unwrap()
        .unwrap()
    }

    fn fill(folder: &Path) {
        std::fs::create_dir_all(folder).unwrap();
        for file in FILES {
            std::fs::write(folder.join(file), "").unwrap();
        }
    }

    #[test]
    fn security_is_off_unless_it_is_asked_for() {
        assert_eq!(security(&[]).unwrap(), None);
        assert_eq!(security(&[("ROS_SECURITY_ENABLE", "")]).unwrap(), None);
        let off = [
            ("ROS_SECURITY_ENABLE", "false"),
            ("ROS_SECURITY_STRATEGY", "Enforce"),
        ];
        assert_eq!(security(&off).unwrap(), None);
    }

    #[test]
    fn words_that_rcl_would_take_for_off_are_refused_by_name() {
        for (name, value) in [
            ("ROS_SECURITY_ENABLE", "TRUE"),
            ("ROS_SECURITY_ENABLE", "1"),
            ("ROS_SECURITY_STRATEGY", "enforce"),
        ] {
            let variables = [(name, value), ("ROS_SECURITY_ENABLE", "true")];
            let text = security(&variables).unwrap_err().to_string();
            assert!(text.contains(name) && text.contains(value), "{text}");
        }
    }

    #[test]
    fn an_enclave_is_found_by_argument_and_the_environment_overrides_it() {
        let folder = tempfile::tempdir().unwrap();
        let enclaves = folder.path().join("enclaves");
        fill(&enclaves.join("sctn/suction_executor"));
        fill(&enclaves.join("other"));
        let mut security = keystore("Enforce", folder.path());
        let found = security.enclave(Some("/sctn/suction_executor")).unwrap();
        assert_eq!(found, Some(enclaves.join("sctn/suction_executor")));
        security.enclave = Some("/other".into());
        let found = security.enclave(Some("/sctn/suction_executor")).unwrap();
        assert_eq!(found, Some(enclaves.join("other")));
        security.enclave = None;
        let text = security.enclave(None).unwrap_err().to_string();
        assert!(text.contains("enclaves/identity_ca.cert.pem"), "{text}");
    }

    #[test]
    fn enforced_every_missing_file_is_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let enclave = folder.path().join("enclaves/sctn");
        for file in FILES {
            fill(&enclave);
            std::fs::remove_file(enclave.join(file)).unwrap();
            let refused = keystore("Enforce", folder.path()).enclave(Some("/sctn"));
            let text = refused.unwrap_err().to_string();
            assert!(text.contains(&format!("enclaves/sctn/{file}")), "{text}");
        }
        let mut without = keystore("Enforce", folder.path());
        without.keystore = None;
        let text = without.enclave(Some("/sctn")).unwrap_err().to_string();
        assert!(text.contains("ROS_SECURITY_KEYSTORE"), "{text}");
    }

    #[test]
    fn permitted_a_node_without_files_starts_unprotected_as_with_rcl() {
        let folder = tempfile::tempdir().unwrap();
        let permissive = keystore("Permissive", folder.path());
        assert_eq!(permissive.enclave(Some("/sctn")).unwrap(), None);
        fill(&folder.path().join("enclaves/sctn"));
        assert!(permissive.enclave(Some("/sctn")).unwrap().is_some());
    }

    #[test]
    fn an_enclave_outside_of_the_keystore_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["sctn", "", "/../keys", "/a//b", "/sctn/", "/a.b", "/1a"] {
            for strategy in ["Enforce", "Permissive"] {
                let refused = keystore(strategy, folder.path()).enclave(Some(name));
                let text = refused.unwrap_err().to_string();
                assert!(text.contains(&format!("{name:?}")), "{text}");
            }
        }
    }

    #[test]
    fn a_revocation_list_is_refused_since_nobody_would_read_it() {
        let folder = tempfile::tempdir().unwrap();
        assert!(check_supported(folder.path()).is_ok());
        std::fs::write(folder.path().join("crl.pem"), "").unwrap();
        let text = check_supported(folder.path()).unwrap_err().to_string();
        assert!(text.contains("crl.pem"), "{text}");
    }
}
