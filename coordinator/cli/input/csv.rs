//! Tables as people's programs write them: a header, then rows.
//!
//! Commas, semicolons or tabs between fields, quotes around them or not, `#` before
//! comments, blank lines anywhere, any line ends. With semicolons a comma in a number is a
//! decimal point, as spreadsheets of half of Europe write it. A field stays on its line.

use super::InputError;
use std::path::Path;

/// More fields than any flight log has.
const MAX_FIELDS: usize = 256;

/// A line and its number in the file, from 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Row {
    /// Line number, from 1.
    pub line: usize,
    /// The fields, spaces around them removed.
    pub fields: Vec<String>,
}

/// A table in memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Table {
    /// The first row.
    pub header: Row,
    /// The others. None has more fields than the header.
    pub rows: Vec<Row>,
    /// The comments, without `#` and the spaces around.
    pub comments: Vec<Row>,
    /// Whether a comma in a number is a decimal point.
    pub decimal_comma: bool,
}

impl Table {
    /// Reads a table of at most `max_rows` rows.
    pub fn parse(file: &Path, text: &str, max_rows: usize) -> Result<Table, InputError> {
        let mut table: Option<Table> = None;
        let mut comments = Vec::new();
        let mut separator = ',';
        for (index, text) in text.lines().enumerate() {
            let (line, text) = (index + 1, text.trim());
            if let Some(comment) = text.strip_prefix('#') {
                comments.push(Row { line, fields: vec![comment.trim().to_string()] });
                continue;
            }
            if text.is_empty() {
                continue;
            }
            if table.is_none() {
                separator = [';', '\t'].into_iter().find(|s| text.contains(*s)).unwrap_or(',');
            }
            let fields = fields(text, separator)
                .map_err(|message| InputError::on_line(file, line, message))?;
            let row = Row { line, fields };
            let Some(table) = &mut table else {
                let decimal_comma = separator == ';';
                table = Some(Table { header: row, rows: vec![], comments: vec![], decimal_comma });
                continue;
            };
            table.add(file, row, max_rows)?;
        }
        let table = table.ok_or_else(|| {
            InputError::in_file(file, "is empty; its first line names the columns")
        })?;
        Ok(Table { comments, ..table })
    }

    fn add(&mut self, file: &Path, mut row: Row, max_rows: usize) -> Result<(), InputError> {
        while row.fields.len() > self.header.fields.len()
            && row.fields.last().is_some_and(String::is_empty)
        {
            row.fields.pop();
        }
        let (has, columns) = (row.fields.len(), self.header.fields.len());
        if has > columns {
            let message = format!("it has {has} fields, but the header names {columns} columns");
            return Err(InputError::on_line(file, row.line, message));
        }
        if self.rows.len() == max_rows {
            let message = format!("there are more than {max_rows} rows; thin them out");
            return Err(InputError::on_line(file, row.line, message));
        }
        self.rows.push(row);
        Ok(())
    }
}

/// Splits a line. A quoted field may hold the separator, and `""` for a quote.
fn fields(text: &str, separator: char) -> Result<Vec<String>, String> {
    let mut fields = vec![String::new()];
    let mut quoted = false;
    let mut letters = text.chars().peekable();
    while let Some(letter) = letters.next() {
        if fields.len() > MAX_FIELDS {
            return Err(format!("it has more than {MAX_FIELDS} fields"));
        }
        match letter {
            '"' if quoted && letters.peek() == Some(&'"') => {
                letters.next();
                fields.last_mut().into_iter().for_each(|field| field.push('"'));
            }
            '"' => quoted = !quoted,
            letter if letter == separator && !quoted => fields.push(String::new()),
            letter => fields.last_mut().into_iter().for_each(|field| field.push(letter)),
        }
    }
    if quoted {
        return Err("a quote is opened and not closed".to_string());
    }
    Ok(fields.iter().map(|field| field.trim().to_string()).collect())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    fn parse(text: &str) -> Result<Table, String> {
        Table::parse(Path::new("f.csv"), text, 5).map_err(|error| error.to_string())
    }

    fn rows(text: &str) -> Vec<Vec<String>> {
        parse(text).expect("a table").rows.into_iter().map(|row| row.fields).collect()
    }

    #[test]
    fn all_common_dialects_give_the_same_table() {
        let expected = vec![vec!["1".to_string(), "2".to_string()]];
        for text in [
            "a,b\n1,2\n",
            "a;b\r\n1;2\r\n",
            "a\tb\n1\t2",
            "# remark\n\n a , b \n\"1\",\"2\"\n\n",
            "\"a\",\"b\"\n1,2,\n",
        ] {
            assert_eq!(rows(text), expected, "{text:?}");
        }
    }

    #[test]
    fn quotes_hold_separators_and_quotes() {
        assert_eq!(rows("a,b\n\"1,\"\"x\"\"\",2"), [["1,\"x\"", "2"]]);
    }

    #[test]
    fn lines_are_counted_from_one_with_comments_and_blanks() {
        let table = parse("# heading: grid\n\na,b\n# x\n1,2").expect("a table");
        assert_eq!((table.header.line, table.rows[0].line), (3, 5));
        assert_eq!(table.comments[0].fields, ["heading: grid"]);
    }

    #[test]
    fn what_is_no_table_is_refused_with_its_line() {
        assert!(parse("").is_err());
        assert_eq!(
            parse("a,b\n1,2,3").unwrap_err(),
            "f.csv:2: it has 3 fields, but the header names 2 columns"
        );
        assert!(parse("a,b\n\"1,2").unwrap_err().starts_with("f.csv:2: a quote"));
        assert!(parse("a\n1\n1\n1\n1\n1\n1").unwrap_err().starts_with("f.csv:7: there are more"));
        assert!(parse(&",".repeat(1000)).unwrap_err().contains("256"));
    }

    proptest! {
        #[test]
        fn any_text_gives_an_answer(text in "[a-c,;\"# \r\n\t1]{0,60}") {
            let _ = parse(&text);
        }
    }
}
