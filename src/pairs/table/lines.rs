//! Text cut into pieces of whole lines, each under the file's first line.

use std::fs::File;
use std::io::{ErrorKind, Read as _};
use std::path::{Path, PathBuf};

use super::form::open;
use crate::io::IoError;
use crate::pairs::PairsError;

/// Longest line, bytes; a line end within quotes ends none.
pub(super) const LINE: usize = 16 << 20;

/// Pieces of about `size` bytes. A line end within quotes ends no line.
pub(super) struct Lines {
    file: File,
    path: PathBuf,
    size: usize,
    /// The first line that is not blank, with its end and what stands before.
    header: Vec<u8>,
    /// What was read and not yet handed out.
    rest: Vec<u8>,
    ended: bool,
}

impl Lines {
    pub(super) fn open(path: &Path, size: usize) -> Result<Self, PairsError> {
        let (file, path) = (open(path)?, path.to_owned());
        let mut out = Self { file, path, size: size.max(1), header: Vec::new(), rest: Vec::new(), ended: false };
        out.header = out.cut(1, first_line)?;
        Ok(out)
    }

    /// Reads on until `end` finds where lines end, from at least `least` bytes; all that is left at the end of the file.
    fn cut(&mut self, least: usize, end: fn(&[u8]) -> Option<usize>) -> Result<Vec<u8>, PairsError> {
        let mut least = least;
        loop {
            while !self.ended && self.rest.len() < least {
                self.fill()?;
            }
            let found = if self.ended || self.rest.len() >= least { end(&self.rest) } else { None };
            if let Some(at) = found {
                let after = self.rest.split_off(at);
                return Ok(std::mem::replace(&mut self.rest, after));
            }
            if self.ended {
                return Ok(std::mem::take(&mut self.rest));
            }
            if self.rest.len() > self.size.max(LINE) {
                let message = format!("a line of more than {} MiB, or a quotation mark without its pair", LINE >> 20);
                return Err(PairsError::Unreadable { form: "text", message, path: self.path.clone() });
            }
            least = self.rest.len() + self.size;
        }
    }

    fn fill(&mut self) -> Result<(), PairsError> {
        let mut block = vec![0; self.size.min(1 << 20)];
        match self.file.read(&mut block) {
            Ok(0) => self.ended = true,
            Ok(read) => self.rest.extend_from_slice(&block[..read]),
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(IoError::os("read", &self.path)(error).into()),
        }
        Ok(())
    }
}

impl Iterator for Lines {
    type Item = Result<Vec<u8>, PairsError>;

    fn next(&mut self) -> Option<Self::Item> {
        match self.cut(self.size, last_line) {
            Ok(lines) if lines.is_empty() => None,
            Ok(lines) => Some(Ok([self.header.as_slice(), &lines].concat())),
            Err(error) => {
                // nothing comes after an error
                (self.ended, self.rest) = (true, Vec::new());
                Some(Err(error))
            }
        }
    }
}

/// Behind the end of the first line that is not blank.
fn first_line(text: &[u8]) -> Option<usize> {
    let (mut quoted, mut blank) = (false, true);
    for (at, &byte) in text.iter().enumerate() {
        quoted ^= byte == b'"';
        blank &= matches!(byte, b'\n' | b'\r');
        if byte == b'\n' && !quoted && !blank {
            return Some(at + 1);
        }
    }
    None
}

/// Behind the end of the last line that ends.
fn last_line(text: &[u8]) -> Option<usize> {
    let (mut quoted, mut end) = (false, None);
    for (at, &byte) in text.iter().enumerate() {
        quoted ^= byte == b'"';
        if byte == b'\n' && !quoted {
            end = Some(at + 1);
        }
    }
    end
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pieces(text: &str, size: usize) -> Vec<String> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.csv");
        crate::io::write_atomic(&path, text.as_bytes()).unwrap();
        let text = |piece: Result<Vec<u8>, PairsError>| String::from_utf8(piece.unwrap()).unwrap();
        Lines::open(&path, size).unwrap().map(text).collect()
    }

    #[test]
    fn pieces_are_whole_lines_under_the_first_and_together_the_file() {
        let text = "a,\"b\nc\"\r\n1,2\r\n3,\"x\n\"\"y\n\"\r\n5,6\r\n7,8";
        let header = "a,\"b\nc\"\r\n";
        assert_eq!(
            pieces(text, 1),
            [
                format!("{header}1,2\r\n"),
                format!("{header}3,\"x\n\"\"y\n\"\r\n"),
                format!("{header}5,6\r\n"),
                format!("{header}7,8"),
            ]
        );
        for size in 1..60 {
            let found = pieces(text, size);
            let joined: String = found.iter().map(|piece| piece.strip_prefix(header).unwrap()).collect();
            assert_eq!(format!("{header}{joined}"), text, "{size}");
        }
        for size in 1..9 {
            assert_eq!(pieces("\r\n\na,b\n1,2\n", size), ["\r\n\na,b\n1,2\n"]);
        }
        assert_eq!(pieces("a,b\n", 10), [""; 0]);
        assert_eq!(pieces("", 10), [""; 0]);
    }

    #[test]
    fn a_quotation_mark_without_its_pair_is_an_error_before_memory_is_full() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.csv");
        crate::io::write_atomic(&path, format!("a,b\n1,\"{}", "2,3\n".repeat(9 << 20)).as_bytes()).unwrap();
        let found: Vec<_> = Lines::open(&path, 1 << 20).unwrap().collect();
        let error = found[0].as_ref().unwrap_err().to_string();
        assert!(error.contains("a line of more than 16 MiB, or a quotation mark without its pair: /"), "{error}");
        assert_eq!(found.len(), 1);
    }
}
