//! A page of texts, tables and pictures, as one HTML file that needs no other, and as Markdown.

use std::fmt::Write as _;

/// A part of a page.
#[derive(Debug, Clone, PartialEq)]
pub enum Block {
    /// A heading; 2 is that of a section.
    Heading(u8, String),
    /// A paragraph.
    Text(String),
    /// Lines to type.
    Code(String),
    /// A table.
    Table {
        /// What it shows.
        caption: String,
        /// The first line.
        head: Vec<String>,
        /// The other lines, each as long as the first; a cell may have lines of its own.
        rows: Vec<Vec<String>>,
    },
    /// A picture.
    Picture {
        /// What it shows.
        caption: String,
        /// Name of its file, beside the Markdown.
        file: String,
        /// The picture.
        svg: String,
    },
}

/// A page.
#[derive(Debug, Clone, PartialEq)]
pub struct Page {
    /// Its title.
    pub title: String,
    /// What is on it.
    pub blocks: Vec<Block>,
}

/// A new line in a cell, in Markdown too.
const BREAK: &str = "<br>";

const STYLE: &str = "body { font: 15px/1.5 sans-serif; max-width: 72em; margin: 2em auto; \
padding: 0 1em; color: #222 } table { border-collapse: collapse; margin: 1em 0; font-size: 13px } \
th, td { border-bottom: 1px solid #ccc; padding: .25em .7em; text-align: left; \
vertical-align: top } th { border-bottom: 2px solid #888 } caption { text-align: left; \
font-weight: bold; padding: .4em 0 } figure { margin: 1.5em 0 } figcaption { max-width: 60em } \
svg { max-width: 100%; height: auto } pre { background: #f4f4f4; padding: .8em; overflow-x: auto } \
@media print { body { max-width: none } figure, table { break-inside: avoid } }";

impl Page {
    /// The page as one HTML file with all pictures in it.
    pub fn html(&self) -> String {
        let title = escaped(&self.title);
        let mut html = format!(
            "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <title>{title}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<h1>{title}</h1>\n"
        );
        for block in &self.blocks {
            html.push_str(&block.html());
        }
        html.push_str("</body>\n</html>\n");
        html
    }

    /// The page as Markdown, with the pictures as files beside it.
    pub fn markdown(&self) -> String {
        let mut markdown = format!("# {}\n", self.title);
        for block in &self.blocks {
            markdown.push('\n');
            markdown.push_str(&block.markdown());
        }
        markdown
    }

    /// The names and contents of the pictures.
    pub fn pictures(&self) -> impl Iterator<Item = (&str, &str)> {
        self.blocks.iter().filter_map(|block| match block {
            Block::Picture { file, svg, .. } => Some((file.as_str(), svg.as_str())),
            _ => None,
        })
    }
}

impl Block {
    fn html(&self) -> String {
        match self {
            Self::Heading(level, text) => format!("<h{level}>{}</h{level}>\n", escaped(text)),
            Self::Text(text) => format!("<p>{}</p>\n", escaped(text)),
            Self::Code(text) => format!("<pre>{}</pre>\n", escaped(text)),
            Self::Table { caption, head, rows } => {
                let row = |tag: &str, cells: &[String]| {
                    let broken = |cell: &String| escaped(cell).replace('\n', BREAK);
                    let cell = |cell| format!("<{tag}>{}</{tag}>", broken(cell));
                    format!("<tr>{}</tr>\n", cells.iter().map(cell).collect::<String>())
                };
                let rows: String = rows.iter().map(|cells| row("td", cells)).collect();
                let (caption, head) = (escaped(caption), row("th", head));
                format!("<table>\n<caption>{caption}</caption>\n{head}{rows}</table>\n")
            }
            Self::Picture { caption, svg, .. } => {
                let caption = escaped(caption);
                format!("<figure>\n{svg}\n<figcaption>{caption}</figcaption>\n</figure>\n")
            }
        }
    }

    fn markdown(&self) -> String {
        match self {
            Self::Heading(level, text) => format!("{} {text}\n", "#".repeat((*level).into())),
            Self::Text(text) => format!("{text}\n"),
            Self::Code(text) => format!("```\n{}\n```\n", text.trim_end()),
            Self::Table { caption, head, rows } => {
                let row = |cells: &[String]| {
                    let cells: Vec<_> =
                        cells.iter().map(|c| c.replace('|', "\\|").replace('\n', BREAK)).collect();
                    format!("| {} |\n", cells.join(" | "))
                };
                let mut table = format!("**{caption}**\n\n{}", row(head));
                let _ = writeln!(table, "|{}", "---|".repeat(head.len()));
                rows.iter().for_each(|cells| table.push_str(&row(cells)));
                table
            }
            Self::Picture { caption, file, .. } => format!("![{caption}]({file})\n\n{caption}\n"),
        }
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_reads_the_same_in_both_forms() {
        let cells = |cells: &[&str]| cells.iter().map(|c| c.to_string()).collect::<Vec<_>>();
        let page = Page {
            title: "Results".into(),
            blocks: vec![
                Block::Heading(2, "Arcs".into()),
                Block::Text("S < 1 & R".into()),
                Block::Code("tcvae report\n".into()),
                Block::Table {
                    caption: "Table 2".into(),
                    head: cells(&["model", "S"]),
                    rows: vec![cells(&["VAE", ".20 | .27\n[.2, .3]"])],
                },
                Block::Picture {
                    caption: "Figure 5".into(),
                    file: "figure-5.svg".into(),
                    svg: "<svg></svg>".into(),
                },
            ],
        };
        assert_eq!(
            page.markdown(),
            "# Results\n\n## Arcs\n\nS < 1 & R\n\n```\ntcvae report\n```\n\n**Table 2**\n\n\
             | model | S |\n|---|---|\n| VAE | .20 \\| .27<br>[.2, .3] |\n\n![Figure 5](figure-5.svg)\n\n\
             Figure 5\n"
        );
        let html = page.html();
        for text in [
            "<h1>Results</h1>",
            "<h2>Arcs</h2>",
            "<p>S &lt; 1 &amp; R</p>",
            "<pre>tcvae report\n</pre>",
            "<tr><th>model</th><th>S</th></tr>\n<tr><td>VAE</td><td>.20 | .27<br>[.2, .3]</td></tr>",
            "<figure>\n<svg></svg>\n<figcaption>Figure 5</figcaption>",
        ] {
            assert!(html.contains(text), "{text} is missing");
        }
        assert_eq!(page.pictures().collect::<Vec<_>>(), [("figure-5.svg", "<svg></svg>")]);
    }
}
