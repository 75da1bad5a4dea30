"""The interface in other languages. Texts that a table lacks, and messages of the engine, stay English.

Blender looks up labels, tooltips and names of properties by itself: a language is a table from English texts to others.
"""

import bpy

from . import EXTENSION

GERMAN = {
    "Scene": "Szene",
    "Check": "Prüfen",
    "Import": "Importieren",
    "Import COLMAP Scene": "COLMAP-Szene importieren",
    "Effects": "Effekte",
    "Plan": "Planen",
    "Plan Again": "Neu planen",
    "Plan Effects": "Effekte planen",
    "Follow Plan": "Plan folgen",
    "On": "Ein",
    "Off": "Aus",
    "Train": "Trainieren",
    "Continue": "Fortsetzen",
    "Pause": "Anhalten",
    "Cancel": "Abbrechen",
    "Show Log": "Protokoll zeigen",
    "More": "Mehr",
    "Method": "Verfahren",
    "Quality": "Güte",
    "Time Budget": "Zeitrahmen",
    "Stop When Flat": "Enden, wenn nichts mehr kommt",
    "Iterations": "Schritte",
    "Width": "Breite",
    "Max Gaussians": "Höchstzahl der Gaußglocken",
    "Water": "Wasser",
    "Metres per Unit": "Meter je Einheit",
    "SH Degree": "SH-Grad",
    "Result": "Ergebnis",
    "Set Up Render": "Rendern vorbereiten",
    "Open Splat File": "Splat-Datei öffnen",
    "Labels": "Etiketten",
    "Export": "Exportieren",
    "Install Engine": "Rechenkern einrichten",
    "Install Engine Again": "Rechenkern neu einrichten",
    "Remove Engine": "Rechenkern entfernen",
    "Check Engine": "Rechenkern prüfen",
    "Look Up Size": "Größe nachsehen",
    "Package Index": "Paketverzeichnis",
    "Folder of Wheels": "Ordner mit Wheels",
    "Open Preferences": "Einstellungen öffnen",
    "As splat viewers show the file: a PLY has its y axis down, a GLB its y axis up": (
        "Wie Splat-Betrachter die Datei zeigen: Im PLY zeigt die y-Achse nach unten, im GLB nach oben"
    ),
    "Axes": "Achsen",
    "Backend": "Rechenweg",
    "Blender's up is up in other programs: y down in a PLY, y up in a GLB": (
        "Was in Blender oben ist, ist es auch in anderen Programmen: y nach unten im PLY, nach oben im GLB"
    ),
    "COLMAP Scene (folder)": "COLMAP-Szene (Ordner)",
    "Cameras": "Kameras",
    "Choice": "Wahl",
    "Click two points of the splats whose distance you know; the scene is then scaled by it": (
        "Zwei Punkte der Splats anklicken, deren Abstand bekannt ist; danach wird die Szene skaliert"
    ),
    "Colour": "Farbe",
    "Cost": "Kosten",
    "Crop Box": "Ausschnitt",
    "Delete the engine's Python environment with all its packages; runs and splats stay": (
        "Die Python-Umgebung des Rechenkerns mit allen Paketen löschen; Läufe und Splats bleiben"
    ),
    "Display": "Anzeige",
    "Distance": "Abstand",
    "Download the packages that training needs into a Python environment of their own": (
        "Die Pakete, die das Training braucht, in eine eigene Python-Umgebung laden"
    ),
    "Effect": "Effekt",
    "Engine": "Renderer",
    "Evidence": "Beleg",
    "Export Gaussian Splats": "Gauß-Splats exportieren",
    "Extend": "Erweitern",
    "Folder": "Ordner",
    "Folder of the masks": "Ordner der Masken",
    "Forecast": "Vorhersagen",
    "Gaussian Splats": "Gauß-Splats",
    "Gaussians": "Gaußglocken",
    "Import Gaussian Splats": "Gauß-Splats importieren",
    "Installing needs online access (Preferences > System > Network) or a folder of wheels.": (
        "Das Einrichten braucht Online-Zugriff (Einstellungen > System > Netzwerk) oder einen Ordner mit Wheels."
    ),
    "Interrupted": "Abgebrochen",
    "Isolate": "Freistellen",
    "Label": "Etikettieren",
    "Length of one Blender unit in metres; the file is in metres": (
        "Länge einer Blender-Einheit in Metern; die Datei ist in Metern"
    ),
    "List the labels of the splats, with the names of the run they are from": (
        "Die Etiketten der Splats auflisten, mit den Namen ihres Laufs"
    ),
    "Look Up Size of Engine": "Größe des Rechenkerns nachsehen",
    "Make Labels": "Etiketten machen",
    "Mask": "Maske",
    "Masks": "Masken",
    "Merge": "Vereinen",
    "Merge Splats": "Splats vereinen",
    "Milliseconds that the effect adds to an iteration here": (
        "Millisekunden, die der Effekt hier zu einem Schritt hinzufügt"
    ),
    "Mix the colour of its label into each splat": "Jedem Splat die Farbe seines Etiketts beimischen",
    "Name": "Name",
    "Node Groups as Assets": "Knotengruppen als Assets",
    "Objects": "Objekte",
    "Only splats of at least this opacity": "Nur Splats von mindestens dieser Deckkraft",
    "Only splats with these labels: names or numbers with commas; empty for all": (
        "Nur Splats mit diesen Etiketten: Namen oder Nummern mit Kommas; leer für alle"
    ),
    "Open Gaussian splats from PLY or GLB files": "Gauß-Splats aus PLY- oder GLB-Dateien öffnen",
    "Open the engine's log of the last job in a text editor": (
        "Das Protokoll des Rechenkerns vom letzten Auftrag in einem Texteditor öffnen"
    ),
    "Pick Two Points": "Zwei Punkte wählen",
    "Python": "Python",
    "Read Labels": "Etiketten lesen",
    "Remove": "Entfernen",
    "Run": "Lauf",
    "Save splat objects as one PLY or GLB file, their transforms and modifiers applied": (
        "Splat-Objekte als eine PLY- oder GLB-Datei speichern, Transformationen und Modifikatoren angewandt"
    ),
    "Scale the scene by the distance between two selected objects, such as cameras, or two points": (
        "Die Szene nach dem Abstand zweier gewählter Objekte, etwa Kameras, oder zweier Punkte skalieren"
    ),
    "Search": "Suchen",
    "Search Splats": "Splats suchen",
    "Seconds": "Sekunden",
    "Seed": "Startwert",
    "Select Label": "Etikett wählen",
    "Select an object with splats first.": "Zuerst ein Objekt mit Splats wählen.",
    "Selected": "Gewählte",
    "Separate": "Trennen",
    "Separate Splats": "Splats trennen",
    "Set Scale": "Maßstab setzen",
    "Show All": "Alle zeigen",
    "Show Colours": "Farben zeigen",
    "Show all labels": "Alle Etiketten zeigen",
    "Show the splats with this label": "Die Splats mit diesem Etikett zeigen",
    "Splats of the last run": "Splats des letzten Laufs",
    "Splats with this label": "Splats mit diesem Etikett",
    "The selected splat objects": "Die gewählten Splat-Objekte",
    "The splats have no fitted water.": "Die Splats haben kein angepasstes Wasser.",
    "Threshold": "Schwelle",
    "Train first, or open a splat file below.": "Zuerst trainieren, oder unten eine Splat-Datei öffnen.",
    "Upright": "Aufrecht",
    "Visible": "Sichtbar",
    "What to label, as in coral, wreck, open water": "Was zu etikettieren ist, wie in coral, wreck, open water",
    "What to look for, such as coral": "Was zu suchen ist, etwa coral",
    "No job has written a log yet": "Noch hat nichts ein Protokoll geschrieben",
    "Nothing differs from the plan": "Nichts weicht vom Plan ab",
    "No training is running": "Es läuft kein Training",
    "There are no splats in the scene": "In der Szene sind keine Splats",
    "Select an object with splats first": "Zuerst ein Objekt mit Splats auswählen",
    "Words": "Worte",
    "Y Up": "Y oben",
    "Z Up": "Z oben",
    "Water Type": "Wassertyp",
    "Which method trains the scene (docs/recipes.md)": "Welches Verfahren die Szene trainiert (docs/recipes.md)",
    "Models the water and the effects that the scene calls for, and removes them": (
        "Modelliert das Wasser und die Effekte, die die Szene verlangt, und entfernt sie"
    ),
    "Plain Gaussian splatting: the scene as photographed": ("Einfaches Gaussian Splatting: die Szene wie fotografiert"),
    "Follows SeaSplat": "Folgt SeaSplat",
    "Follows UW-GS": "Folgt UW-GS",
    "Follows WaterSplatting": "Folgt WaterSplatting",
    "Follows RUSplatting": "Folgt RUSplatting",
    "Follows SWAGSplatting as published": "Folgt SWAGSplatting wie veröffentlicht",
    "How long to train and at which size": "Wie lange und in welcher Größe trainiert wird",
    "To see whether a scene works": "Um zu sehen, ob eine Szene geht",
    "A good result in moderate time": "Ein gutes Ergebnis in mäßiger Zeit",
    "For a result to keep": "Für ein Ergebnis, das bleibt",
    (
        "Time that the whole run may take, such as 90s, 10m or 1h30m; the size is then chosen by measuring this "
        "machine, in place of a preset"
    ): (
        "Zeit, die der ganze Lauf brauchen darf, wie 90s, 10m oder 1h30m; die Größe wird dann durch Messen auf "
        "diesem Rechner gewählt statt nach der Güte"
    ),
    "Number of optimisation steps, each on one image; 0: as many as the preset has": (
        "Zahl der Optimierungsschritte, jeder mit einem Bild; 0: so viele, wie die Güte vorsieht"
    ),
    "Width in pixels of the training images; smaller images keep their size; 0: as the preset has it": (
        "Breite der Trainingsbilder in Pixeln; kleinere Bilder behalten ihre Größe; 0: wie es die Güte vorsieht"
    ),
    "Largest number of Gaussians that densification may reach; 0: as many as the preset has": (
        "Größte Zahl an Gaußglocken, bis zu der verdichtet wird; 0: so viele, wie die Güte vorsieht"
    ),
    "End early when a fifth of the run has improved the validation PSNR by less than 0.05 dB": (
        "Früher enden, wenn ein Fünftel des Laufs das PSNR der Prüffotos um weniger als 0,05 dB verbessert hat"
    ),
    "Effects and parts of the method to switch by hand, such as water=off,lamp=on (docs/recipes.md lists them)": (
        "Effekte und Teile des Verfahrens, die von Hand geschaltet werden, wie water=off,lamp=on (docs/recipes.md"
        " listet sie auf)"
    ),
    "What to label while training with semantics=on, such as coral, wreck, open water; needs pretrained networks": (
        "Was beim Training mit semantics=on zu etikettieren ist, wie coral, wreck, open water; braucht "
        "vortrainierte Netze"
    ),
    (
        "Folder of mask images to label by instead of words; without both, masks in the scene's folder labels are"
        " used, or else saliency"
    ): (
        "Ordner mit Maskenbildern statt Worten; ohne beides gelten Masken im Ordner labels der Szene, sonst die "
        "Auffälligkeit"
    ),
    (
        "Initial attenuation of the water: auto fits it to the photos; or a Jerlov type (I IA IB II III 1C 3C 5C "
        "7C 9C), or three numbers per metre for red, green and blue, such as 0.3,0.1,0.06"
    ): (
        "Anfangswert der Dämpfung des Wassers: auto bestimmt ihn aus den Fotos; oder ein Jerlov-Typ (I IA IB II "
        "III 1C 3C 5C 7C 9C), oder drei Zahlen je Meter für Rot, Grün und Blau, wie 0.3,0.1,0.06"
    ),
    "Length in metres of one unit of the scene's coordinates; 0: unknown": (
        "Länge einer Einheit der Szenenkoordinaten in Metern; 0: unbekannt"
    ),
    "Degree of the spherical harmonics, which let color change with the viewing direction": (
        "Grad der Kugelflächenfunktionen, durch die sich Farbe mit der Blickrichtung ändern kann"
    ),
    "Seed of everything random: the same seed on the same machine gives the same result": (
        "Startwert für alles Zufällige: Derselbe Startwert gibt auf demselben Rechner dasselbe Ergebnis"
    ),
    "What computes": "Was rechnet",
    "The fastest that runs on this machine": "Das Schnellste, was auf diesem Rechner läuft",
    "Native code on the processor": "Maschinencode auf dem Prozessor",
    "Native code on an NVIDIA graphics card": "Maschinencode auf einer NVIDIA-Grafikkarte",
    "PyTorch without native code: slow, the reference for the others": (
        "PyTorch ohne Maschinencode: langsam, der Maßstab für die anderen"
    ),
    "A Python that has the engine's packages; empty: the environment of Install Engine": (
        "Ein Python mit den Paketen des Rechenkerns; leer: die Umgebung von „Rechenkern einrichten“"
    ),
    "A job is running: wait for its end, or cancel it": "Ein Auftrag läuft: sein Ende abwarten oder ihn abbrechen",
    "Add Water to Objects": "Objekten Wasser hinzufügen",
    (
        "Address of an additional package index, for another build of torch than the usual one: PyTorch's own"
        " has builds without CUDA and for each version of CUDA (pytorch.org, Get Started)"
    ): (
        "Adresse eines zusätzlichen Paketverzeichnisses, für eine andere Fassung von torch als die übliche: "
        "Das von PyTorch hat Fassungen ohne CUDA und für jede Version von CUDA (pytorch.org, Get Started)"
    ),
    "All splat objects that are visible in the viewport": "Alle Splat-Objekte, die in der Ansicht sichtbar sind",
    "Analyse the photos and list which effects training should model, with evidence and cost": (
        "Die Fotos auswerten und auflisten, welche Effekte das Training modellieren soll, mit Beleg und Kosten"
    ),
    "As the plan decided; undetermined effects stay off": (
        "Wie der Plan entschieden hat; unbestimmte Effekte bleiben aus"
    ),
    "As Trained": "Wie trainiert",
    (
        "Blend sRGB values under the view transform Raw, as training does, to compare renders with photos; "
        "other objects get wrong colours. Off: blend linear light, right beside other objects"
    ): (
        "sRGB-Werte unter der Ansichtstransformation Raw mischen, wie das Training, um Bilder mit Fotos zu "
        "vergleichen; andere Objekte bekommen falsche Farben. Aus: lineares Licht mischen, richtig neben "
        "anderen Objekten"
    ),
    "COLMAP Scene": "COLMAP-Szene",
    "Check Photos": "Fotos prüfen",
    "Choose a Python that has the packages of requirements.txt:": (
        "Ein Python wählen, das die Pakete von requirements.txt hat:"
    ),
    "Choose the folder with the photos first.": "Zuerst den Ordner mit den Fotos wählen.",
    "Continue the run in the run folder where it stopped": (
        "Den Lauf im Ordner des Laufs fortsetzen, wo er stehen blieb"
    ),
    "Count the photos, cameras and points of the folder, and list the problems found": (
        "Fotos, Kameras und Punkte des Ordners zählen und gefundene Probleme auflisten"
    ),
    "Counts and warnings of the folder of photos": "Anzahlen und Warnungen zum Ordner der Fotos",
    "Decision of the plan: on, off or undetermined": "Entscheidung des Plans: ein, aus oder unbestimmt",
    "Distance between the two after scaling": "Abstand zwischen den beiden nach dem Skalieren",
    "Do not model it, whatever the plan decided": "Nicht modellieren, wie auch der Plan entschieden hat",
    "Download Networks": "Netze herunterladen",
    "Download networks that are not on this machine from their authors": (
        "Netze, die auf diesem Rechner fehlen, von ihren Urhebern herunterladen"
    ),
    "Duration of the last run": "Dauer des letzten Laufs",
    "Extra Properties": "Weitere Eigenschaften",
    "Figures of the decision, with their thresholds": "Zahlen der Entscheidung, mit ihren Schwellen",
    "Find splats by words: writes swag:similarity and selects the splats above the threshold": (
        "Splats nach Worten finden: schreibt swag:similarity und wählt die Splats über der Schwelle"
    ),
    "Folder that the training writes to; empty: the folder swag_run beside the COLMAP model": (
        "Ordner, in den das Training schreibt; leer: der Ordner swag_run neben dem COLMAP-Modell"
    ),
    "Folder with the photos and their COLMAP model": "Ordner mit den Fotos und ihrem COLMAP-Modell",
    "Follow the plan again in every effect": "In jedem Effekt wieder dem Plan folgen",
    "Forecast of each quality and the settings it was made for, as JSON": (
        "Vorhersage für jede Güte und die Einstellungen, für die sie gilt, als JSON"
    ),
    (
        "Fraction of the fitted water in the colours, from 0 (none) to 1 (as photographed). Colours with "
        "water are right from the cameras of the photos only, and the file has no water behind the splats"
    ): (
        "Anteil des angepassten Wassers in den Farben, von 0 (keins) bis 1 (wie fotografiert). Farben mit "
        "Wasser stimmen nur von den Kameras der Fotos aus, und hinter den Splats hat die Datei kein Wasser"
    ),
    "Fraction of the fitted water that is shown: 0 none, 1 as photographed; it can be animated": (
        "Anteil des angepassten Wassers, der gezeigt wird: 0 keins, 1 wie fotografiert; er lässt sich animieren"
    ),
    "From Selection": "Aus Auswahl",
    "Give every splat of the run a label: from your masks, from words or from salient regions": (
        "Jedem Splat des Laufs ein Etikett geben: aus eigenen Masken, aus Worten oder aus auffälligen Bereichen"
    ),
    ("Highest degree of spherical harmonics; 0 makes colours the same from every view, and the smallest file"): (
        "Höchster Grad der Kugelflächenfunktionen; mit 0 sind Farben aus jedem Blick gleich und die Datei am kleinsten"
    ),
    (
        "Highest degree of spherical harmonics; a lower one takes less memory, and 0 makes colours the same "
        "from every view"
    ): (
        "Höchster Grad der Kugelflächenfunktionen; ein kleinerer braucht weniger Speicher, und mit 0 sind "
        "Farben aus jedem Blick gleich"
    ),
    "Import a scene or open splats; where there are several, select one of them": (
        "Eine Szene importieren oder Splats öffnen; wo es mehrere gibt, eins davon auswählen"
    ),
    "Import the cameras, the photos and the points of a COLMAP reconstruction": (
        "Kameras, Fotos und Punkte einer COLMAP-Rekonstruktion importieren"
    ),
    "In the COLMAP coordinates of the imported scene that the file belongs to": (
        "In den COLMAP-Koordinaten der importierten Szene, zu der die Datei gehört"
    ),
    (
        "Install from the wheels in this folder, without internet. On a computer with internet, pip download "
        "-r requirements.txt -c constraints.txt fills it"
    ): (
        "Aus den Wheels in diesem Ordner einrichten, ohne Internet. Auf einem Rechner mit Internet füllt ihn "
        "pip download -r requirements.txt -c constraints.txt"
    ),
    "List what the engine's Python has: packages with versions, processor, graphics card": (
        "Auflisten, was das Python des Rechenkerns hat: Pakete mit Versionen, Prozessor, Grafikkarte"
    ),
    ("Look up which build of torch would be installed and how much would be downloaded, without downloading it"): (
        "Nachsehen, welche Fassung von torch eingerichtet und wie viel heruntergeladen würde, ohne es herunterzuladen"
    ),
    "Minimum Opacity": "Mindestdeckkraft",
    "Model it, whatever the plan decided": "Modellieren, wie auch der Plan entschieden hat",
    "Move the selected splats to a new object": "Die gewählten Splats in ein neues Objekt verschieben",
    "Move the splats of the other selected objects into the active one": (
        "Die Splats der anderen gewählten Objekte in das aktive verschieben"
    ),
    "Name of the mask; empty: the words of the search": "Name der Maske; leer: die Worte der Suche",
    "Networks that find what you name in the photos": "Netze, die in den Fotos finden, was man nennt",
    "No environment is installed": "Es ist keine Umgebung eingerichtet",
    "Only splats inside the bounding box of this object; an empty has its cube": (
        "Nur Splats im Hüllquader dieses Objekts; bei einem Leerobjekt in seinem Würfel"
    ),
    "Open water, salient regions and the rest; needs no networks": (
        "Offenes Wasser, auffällige Bereiche und der Rest; braucht keine Netze"
    ),
    "Other photos were chosen after the plan was made": "Nach dem Plan wurden andere Fotos gewählt",
    "PLY in the COLMAP coordinates of the imported scene": "PLY in den COLMAP-Koordinaten der importierten Szene",
    "PLY with Blender's own axes; a GLB always has y up": "PLY mit Blenders eigenen Achsen; ein GLB hat y immer oben",
    "PLY with y up, for programs that do not turn a PLY; a GLB always has y up": (
        "PLY mit y oben, für Programme, die ein PLY nicht drehen; ein GLB hat y immer oben"
    ),
    "PSNR on held-out photos, in dB": "PSNR an zurückgehaltenen Fotos, in dB",
    "Pause or Resume": "Anhalten oder fortsetzen",
    "Pause the training, or resume it; the result is the same as without a pause": (
        "Das Training anhalten oder fortsetzen; das Ergebnis ist dasselbe wie ohne Pause"
    ),
    "Photos": "Fotos",
    "Photos with COLMAP Model": "Fotos mit COLMAP-Modell",
    "Placement": "Platzierung",
    "Plan determines from the photos which effects training should model.": (
        "Planen bestimmt aus den Fotos, welche Effekte das Training modellieren soll."
    ),
    "Remove Water from Objects": "Wasser von Objekten entfernen",
    "Remove the asset library and its files": "Die Asset-Bibliothek und ihre Dateien entfernen",
    "Remove the water's nodes from the materials": "Die Knoten des Wassers aus den Materialien entfernen",
    "Render engine to set up": "Renderer, der vorbereitet wird",
    "Resume": "Weiter",
    "Run folder that the names are from": "Ordner des Laufs, aus dem die Namen sind",
    "Run folder; empty: the folder of the run of the splats": "Ordner des Laufs; leer: der Ordner des Laufs der Splats",
    "SSIM on held-out photos": "SSIM an zurückgehaltenen Fotos",
    "Salient Regions": "Auffällige Bereiche",
    "Save as Mask": "Als Maske speichern",
    "Save labels and other properties of the splats too": (
        "Auch Etiketten und andere Eigenschaften der Splats speichern"
    ),
    (
        "Save the cameras of the photos too, without lens distortion: in a GLB, and beside the file as a "
        "COLMAP text model, transforms.json and, where the run has a water, water.json"
    ): (
        "Auch die Kameras der Fotos speichern, ohne Verzeichnung: im GLB, und neben der Datei als COLMAP-"
        "Textmodell, transforms.json und, wo der Lauf ein Wasser hat, water.json"
    ),
    "Save the selection as an attribute mask:NAME, for geometry nodes": (
        "Die Auswahl als Attribut mask:NAME speichern, für Geometrieknoten"
    ),
    "Select objects with materials, in a scene whose splats have a fitted water": (
        "Objekte mit Materialien auswählen, in einer Szene, deren Splats ein angepasstes Wasser haben"
    ),
    "Select the splats of this label; with Shift in addition to the selection": (
        "Die Splats dieses Etiketts wählen; mit Umschalt zusätzlich zur Auswahl"
    ),
    ("Set up Cycles or EEVEE for splats: transparency, colours, the background of the training, image size"): (
        "Cycles oder EEVEE für Splats vorbereiten: Transparenz, Farben, der Hintergrund des Trainings, Bildgröße"
    ),
    "Show the selected objects through the water of the splats, by nodes in their materials": (
        "Die gewählten Objekte durch das Wasser der Splats zeigen, durch Knoten in ihren Materialien"
    ),
    "Show this label alone; click again to show all labels": (
        "Dieses Etikett allein zeigen; ein weiterer Klick zeigt alle Etiketten"
    ),
    "Sorts every splat by depth, among other objects and other splat objects too": (
        "Ordnet jeden Splat nach seiner Tiefe ein, auch zwischen anderen Objekten und anderen Splat-Objekten"
    ),
    "Source": "Quelle",
    "Splats with a higher similarity than this to the search are selected": (
        "Splats, die dem Gesuchten ähnlicher sind als dies, werden gewählt"
    ),
    "No job is running": "Es läuft kein Auftrag",
    "Stop the running job; a training keeps its result so far": (
        "Den laufenden Auftrag abbrechen; ein Training behält sein bisheriges Ergebnis"
    ),
    "The job is stopping already": "Der Auftrag hält schon an",
    "The masks in the scene's folder labels, or salient regions where it has none": (
        "Die Masken im Ordner labels der Szene, oder auffällige Bereiche, wo sie keine hat"
    ),
    "This plan was made for other photos: plan again.": "Dieser Plan gilt für andere Fotos: neu planen.",
    "Train 3D Gaussians on the photos; Cancel stops and keeps the result so far": (
        "3D-Gaußglocken mit den Fotos trainieren; Abbrechen hält an und behält das bisherige Ergebnis"
    ),
    "Train for some seconds and forecast the time, PSNR and memory of each quality on this machine": (
        "Einige Sekunden trainieren und Zeit, PSNR und Speicher jeder Güte auf diesem Rechner vorhersagen"
    ),
    "Training runs in a separate Python; opening, showing and exporting splats needs none.": (
        "Das Training läuft in einem eigenen Python; Öffnen, Zeigen und Exportieren von Splats braucht keins."
    ),
    "Uses the graphics card; draws one splat object completely in front of another": (
        "Nutzt die Grafikkarte; zeichnet ein Splat-Objekt ganz vor einem anderen"
    ),
    "Value of swag:label": "Wert von swag:label",
    "Water that the last run fitted": "Wasser, das der letzte Lauf angepasst hat",
    "What assigns the labels": "Woraus die Etiketten bestimmt werden",
    "What to look for; empty: the words in the panel": "Was zu suchen ist; leer: die Worte im Feld",
    "Whether the last run was stopped before its end": "Ob der letzte Lauf vor seinem Ende abgebrochen wurde",
    "Whether training models this effect": "Ob das Training diesen Effekt modelliert",
    "Write the node groups of splats and water to an asset library, for the asset browser in every file": (
        "Die Knotengruppen von Splats und Wasser in eine Asset-Bibliothek schreiben, für den Asset-Browser in"
        " jeder Datei"
    ),
    "Your own mask images: one folder for each label, with an image for each photo": (
        "Eigene Maskenbilder: ein Ordner für jedes Etikett, mit einem Bild für jedes Foto"
    ),
    "or install one in the extension's own folder (0.5 GB, with CUDA 3 GB):": (
        "oder eins im Ordner der Erweiterung einrichten (0,5 GB, mit CUDA 3 GB):"
    ),
}


def table(words: dict[str, str]) -> dict[tuple[str, str], str]:
    """The table in Blender's format: texts of operators have another context than all others."""
    return {(context, english): own for english, own in words.items() for context in ("*", "Operator")}


def register() -> None:
    """Register the translations with Blender."""
    bpy.app.translations.register(EXTENSION, {"de_DE": table(GERMAN)})


def unregister() -> None:
    """Undo `register`."""
    bpy.app.translations.unregister(EXTENSION)
