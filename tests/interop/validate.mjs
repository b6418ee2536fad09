// What Khronos' validator says of glTF files, one JSON object a file:
//
//     node validate.mjs FOLDER-OF-VALIDATOR FILE ...

import { readFileSync } from 'node:fs';
import { join } from 'node:path';
import { pathToFileURL } from 'node:url';

const [ folder, ...files ] = process.argv.slice( 2 );
const { default: validator } = await import( pathToFileURL( join( folder, 'index.js' ) ).href );

for ( const file of files ) {

	const { issues } = await validator.validateBytes( new Uint8Array( readFileSync( file ) ) );
	const said = issues.messages.map( ( { code, pointer } ) => `${ code } ${ pointer }` );
	console.log( JSON.stringify( { file, errors: issues.numErrors, warnings: issues.numWarnings, said } ) );

}
